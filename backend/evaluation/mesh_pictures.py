"""Meshes as a contact sheet: of each one the surface, its wires and its texture, drawn from where it shows well."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ..capture import Capture
from ..capture.capture import View
from ..mesh.zbuffer import draw_mesh
from ..mesh_file import Mesh
from ..protocol import Reporter, write_atomic
from ..raster.camera import Camera
from .meshes import sample_texture
from .pictures import _font, _shortened

MESHES_SHOWN = 24
_CELL = 236
_PIXELS = 1_260_000
"""All panels together have so many pixels at most, so that the sheet's file stays small; a panel is _CELL at most."""
_FINER = 3
"""Pictures are drawn so many times larger than they are shown."""
_PAPER = (255, 255, 255)
_PANEL = (246, 246, 248)
_INK = (38, 38, 42)
_FAINT = (118, 118, 124)
_CLAY = np.array([0.80, 0.80, 0.80])
_INVENTED = np.array([0.98, 0.66, 0.36])
_WIRE = np.array([0.24, 0.27, 0.33])
_VIEWS_ASKED = 60
_FIELD = np.radians(28.0)
_FILLED = 0.88
"""So much of a panel's width or height the mesh takes."""


@dataclass
class Card:
    """What the sheet shows of one mesh: its name, a line of figures, and the mesh with its texture (S, S, 3) uint8 or
    None, as `view` sees it; without a mesh, `why` there is none."""

    name: str
    figures: str
    mesh: Mesh | None = None
    texture: np.ndarray | None = None
    view: View | None = None
    why: str = ""


def view_of(capture: Capture, ids: Sequence[int] | None, indices: Sequence[int]) -> View:
    """The one among the views `indices` that shows most pixels of the objects `ids` (None: the whole scene, so any)."""
    asked = list(indices)[:: max(1, len(indices) // _VIEWS_ASKED)]
    best, most = asked[0], -1
    for index in asked:
        mask = capture.mask(index)
        pixels = 0 if mask is None or ids is None else int(np.isin(mask, ids).sum())
        if pixels > most:
            best, most = index, pixels
    return capture.views[best]


def camera_for(vertices: np.ndarray, view: View, size: int) -> Camera:
    """A camera of size x size pixels: where `view` is, if it stands within the box of the vertices (V, 3), in a room
    for instance; otherwise turned as `view` is, at the distance from which all vertices just fit in."""
    low, high = vertices.min(0), vertices.max(0)
    viewmat = np.array(view.viewmat, np.float64)
    pose = viewmat[:3, :3]
    place = -pose.T @ viewmat[:3, 3]
    if ((place > low) & (place < high)).all():
        focal = size * max(view.K[0, 0] / view.width, view.K[1, 1] / view.height)
        away = float((high - low).max())
    else:
        middle = (low + high) / 2
        seen = (vertices - middle) @ pose.T
        slope = np.tan(_FIELD / 2)
        # What is nearer looks larger, so the picture's middle is not the box's.
        away, centre = 0.0, np.zeros(2)
        for _ in range(5):
            away = max(float((np.abs(seen[:, :2] - centre).max(1) / slope - seen[:, 2]).max()), 1e-12)
            projected = (seen[:, :2] - centre) / np.maximum(seen[:, 2:] + away, 1e-9 * away)
            centre += (projected.max(0) + projected.min(0)) / 2 * away
        viewmat[:3, 3] = -pose @ middle + [-centre[0], -centre[1], away]
        focal = _FILLED * size / (2 * slope)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, size, size, away * 1e-4)


def draw_card(card: Card, size: int = _CELL) -> list[Image.Image]:
    """The mesh shaded, as wires and with its texture: three pictures of size x size pixels."""
    mesh = card.mesh
    assert mesh is not None and card.view is not None
    camera = camera_for(mesh.vertices[np.unique(mesh.faces)], card.view, size * _FINER)
    pose = camera.viewmat[:3, :3]
    _, face, weights = draw_mesh(mesh.vertices, mesh.faces, camera)
    drawn = face >= 0
    hit, weights = face[drawn], weights[drawn]
    corners = mesh.faces[hit]
    normals = np.einsum("nc,ncx->nx", weights, mesh.normals[corners]) @ pose.T
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    rows, columns = np.nonzero(drawn)
    towards = np.stack([(columns - camera.width / 2) / camera.K[0, 0], (rows - camera.height / 2) / camera.K[1, 1]], 1)
    towards = np.concatenate([towards, np.ones((len(hit), 1))], 1)
    inside = (normals * towards).sum(1) > 0
    normals[inside] *= -1
    light = _light(normals) * np.where(inside, 0.82, 1.0)
    clay = _CLAY * light[:, None]
    paint = np.where(mesh.invented[hit][:, None], _INVENTED, _CLAY)
    wires = _wires(mesh, camera, hit, rows, columns)[:, None]
    wired = (0.35 + 0.65 * light[:, None]) * paint * 1.12 * (1 - wires) + _WIRE * wires
    looks = [clay, wired]
    if card.texture is not None:
        looks.append(sample_texture(card.texture, np.einsum("nc,ncx->nx", weights, mesh.uvs[hit])))
    else:
        looks.append(np.einsum("nc,ncx->nx", weights, mesh.colors[corners]) / 255)
    return [_panel(drawn, look, size) for look in looks]


def _light(normals: np.ndarray) -> np.ndarray:
    """How bright surfaces with these normals (n, 3), camera axes, are: a soft lamp above the left shoulder, a fill from
    the right, and sky."""
    key = np.clip(normals @ _unit(-0.55, -0.75, -0.75), 0, 1)
    fill = np.clip(normals @ _unit(0.9, -0.1, -0.5), 0, 1)
    sky = 0.5 - 0.5 * normals[:, 1]
    return np.clip(0.30 + 0.62 * key + 0.13 * fill + 0.14 * sky, 0, 1.15)


def _unit(*xyz: float) -> np.ndarray:
    return np.array(xyz) / np.linalg.norm(xyz)


def _wires(mesh: Mesh, camera: Camera, hit: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """How much of each drawn pixel (n,) lies under an edge of its own face, 0 .. 1."""
    seen = mesh.vertices @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    flat = seen[:, :2] / np.maximum(seen[:, 2:], camera.near) * camera.K[0, 0] + camera.K[:2, 2]
    corners = flat[mesh.faces[hit]]
    nearest = np.full(len(hit), np.inf)
    pixel = np.stack([columns, rows], 1) + 0.5
    for k in range(3):
        start, end = corners[:, k], corners[:, (k + 1) % 3]
        along, away = end - start, pixel - start
        length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
        nearest = np.minimum(nearest, np.abs(along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]) / length)
    return 0.62 * np.clip(0.32 * _FINER + 0.5 - nearest, 0, 1)


def _panel(drawn: np.ndarray, colours: np.ndarray, size: int) -> Image.Image:
    """Drawn pixels on the panel's own grey, reduced to size x size."""
    picture = np.empty((*drawn.shape, 3), np.float32)
    picture[:] = np.array(_PANEL) / 255
    picture[drawn] = colours
    blocks = picture.reshape(size, _FINER, size, _FINER, 3).mean((1, 3))
    return Image.fromarray(np.rint(np.clip(blocks, 0, 1) * 255).astype(np.uint8))


def mesh_sheet(cards: Sequence[Card], reporter: Reporter | None = None) -> Image.Image:
    """All cards in one picture: a name and figures over three panels each, two cards side by side from four on."""
    size = min(_CELL, int((_PIXELS / (3 * max(len(cards), 1))) ** 0.5))
    columns = 1 if len(cards) < 4 else 2
    gap, margin, gutter, head, below = 6, 24, 32, 38, 20
    name_font, font = _font(16), _font(12)
    wide = 3 * size + 2 * gap
    rows = -(-len(cards) // columns)
    top = margin + 22
    sheet = Image.new(
        "RGB", (2 * margin + columns * wide + (columns - 1) * gutter, top + rows * (head + size + below)), _PAPER
    )
    draw = ImageDraw.Draw(sheet)
    for column in range(columns):
        for k, text in enumerate(("surface", "wires, orange: invented", "texture")):
            x = margin + column * (wide + gutter) + k * (size + gap)
            draw.text((x, margin - 8), text, _FAINT, font)
    for place, card in enumerate(cards):
        x = margin + (place % columns) * (wide + gutter)
        y = top + (place // columns) * (head + size + below)
        draw.line((x, y, x + wide, y), (226, 226, 230), 1)
        draw.text((x, y + 11), _shortened(card.name, name_font, wide * 0.45), _INK, name_font)
        figures = _shortened(card.figures, font, wide * 0.55)
        draw.text((x + wide - font.getlength(figures), y + 14), figures, _FAINT, font)
        if reporter is not None:
            reporter.progress(place, len(cards), what="meshes")
        if card.mesh is None:
            draw.rounded_rectangle((x, y + head, x + wide - 1, y + head + size - 1), 6, _PANEL)
            text = _shortened(card.why or "no mesh", font, wide - 40)
            draw.text((x + (wide - font.getlength(text)) / 2, y + head + size / 2 - 8), text, _FAINT, font)
            continue
        for k, picture in enumerate(draw_card(card, size)):
            sheet.paste(picture, (x + k * (size + gap), y + head), _rounded(size))
    if reporter is not None:
        reporter.progress(len(cards), len(cards), what="meshes")
    return sheet


def _rounded(size: int) -> Image.Image:
    mask = Image.new("L", (4 * size, 4 * size), 0)
    ImageDraw.Draw(mask).rounded_rectangle((0, 0, 4 * size - 1, 4 * size - 1), 24, 255)
    return mask.resize((size, size), Image.Resampling.LANCZOS)


def save_sheet(sheet: Image.Image, path: Path, limit: int = 300_000) -> Path:
    """Write `sheet` atomically as PNG of at most `limit` bytes: with 256 colours where all of them take more, and
    smaller where that is not enough."""
    picture, scale = sheet, 1.0
    while True:
        buffer = io.BytesIO()
        picture.save(buffer, "PNG", optimize=True)
        if buffer.tell() <= limit or min(picture.size) < 64:
            write_atomic(path, buffer.getvalue())
            return path
        if picture.mode == "P":
            scale *= min(0.95, (limit / buffer.tell()) ** 0.5)
        size = max(1, round(sheet.width * scale)), max(1, round(sheet.height * scale))
        smaller = sheet if size == sheet.size else sheet.resize(size, Image.Resampling.LANCZOS)
        picture = _in_few_colours(smaller)


def _in_few_colours(picture: Image.Image) -> Image.Image:
    """The picture in 256 colours: the sheet's own two, exactly, and those that fit the rest."""
    pixels = np.asarray(picture)
    # Every third row and column is enough, and a colour that fills much must not take the others' places.
    found, count = np.unique(pixels[::3, ::3].reshape(-1, 3) >> 2, axis=0, return_counts=True)
    several = np.repeat(4 * found + 2, np.ceil(count**0.3).astype(int), axis=0).astype(np.uint8)
    fitted = Image.fromarray(several[None]).quantize(254, Image.Quantize.MEDIANCUT, kmeans=3)
    palette = Image.new("P", (1, 1))
    palette.putpalette([*_PAPER, *_PANEL, *(fitted.getpalette() or [])[: 3 * 254]])
    placed = np.array(picture.quantize(palette=palette, dither=Image.Dither.NONE))
    # Pillow takes near colours for equal ones.
    for place, own in enumerate((_PAPER, _PANEL)):
        placed[(pixels == own).all(2)] = place
    few = Image.fromarray(placed, "P")
    few.putpalette(palette.getpalette() or [])
    return few


def figures_line(figures: Mapping[str, Any]) -> str:
    """The figures that a reader looks for first, on one line."""
    parts = []
    if figures.get("f1") is not None:
        parts.append(f"F1 {figures['f1']:.3f}")
    if figures.get("texture_psnr") is not None:
        parts.append(f"{figures['texture_psnr']:.1f} dB")
    if figures.get("faces") is not None:
        parts.append(f"{figures['faces']:,} faces")
    if figures.get("watertight") is False:
        parts.append("open")
    return "  ·  ".join(parts)
