"""A contact sheet of meshes: the surface, the wireframe and the texture of each one."""

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
from ..mesh.texture.zbuffer import draw_mesh
from ..raster.camera import Camera
from ..shared.events import Reporter
from ..shared.formats.atomic import write_atomic
from ..shared.formats.mesh_ply import Mesh
from .images import load_font, shorten
from .meshes import sample_texture

MESHES_SHOWN = 24
TEXELS_SHOWN = 1024
"""Width of a texture that suffices for a panel."""
_CELL = 236
_PIXELS = 1_260_000
"""Largest total number of pixels of all panels, to limit the file size; a panel is at most _CELL wide."""
_FINER = 3
"""Supersampling factor of the panels."""
_PAPER = (255, 255, 255)
_PANEL = (246, 246, 248)
_INK = (38, 38, 42)
_FAINT = (118, 118, 124)
_CLAY = np.array([0.80, 0.80, 0.80])
_UNOBSERVED = np.array([0.98, 0.66, 0.36])
_WIRE = np.array([0.24, 0.27, 0.33])
_MAX_SAMPLED_VIEWS = 60
_FIELD = np.radians(28.0)
_FILLED = 0.88
"""Fraction of a panel's width or height that the mesh fills."""


@dataclass
class Card:
    """The entry of one mesh in the sheet.

    Attributes:
        name: Heading.
        figures: A line of figures.
        mesh: The mesh, or None.
        texture: (S, S, 3) uint8, or None.
        view: The view from which the mesh is drawn.
        why: The reason if there is no mesh.
    """

    name: str
    figures: str
    mesh: Mesh | None = None
    texture: np.ndarray | None = None
    view: View | None = None
    why: str = ""


def view_of(capture: Capture, ids: Sequence[int] | None, indices: Sequence[int]) -> View:
    """Choose the view to draw a mesh from.

    Args:
        capture: The capture, with masks of its views.
        ids: IDs of the objects of the mesh; None for the whole scene.
        indices: The views to choose from, at least one; a sample of them is looked at.

    Returns:
        The view with the most pixels of these objects, the first of equals; the first view if `ids` is None.

    Raises:
        InputError: A mask cannot be read.
    """
    best, most = indices[0], 0
    for index in indices[:: max(1, len(indices) // _MAX_SAMPLED_VIEWS)]:
        # A mask that shows none of them need not be read.
        if ids is None or set(ids).isdisjoint(capture.ids_in(index)):
            continue
        mask = capture.mask(index)
        pixels = 0 if mask is None else int(np.isin(mask, ids).sum())
        if pixels > most:
            best, most = index, pixels
    return capture.views[best]


def camera_for(vertices: np.ndarray, view: View, size: int) -> Camera:
    """Return a camera of size x size pixels that shows the vertices (V, 3).

    If `view` lies inside their bounding box, as in a room, the camera has the pose of `view`. Otherwise it has the
    orientation of `view` and the distance at which all vertices just fit into the image.
    """
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
        # Due to the perspective, the center of the image differs from that of the bounding box.
        away, center = 0.0, np.zeros(2)
        for _ in range(5):
            away = max(float((np.abs(seen[:, :2] - center).max(1) / slope - seen[:, 2]).max()), 1e-12)
            projected = (seen[:, :2] - center) / np.maximum(seen[:, 2:] + away, 1e-9 * away)
            center += (projected.max(0) + projected.min(0)) / 2 * away
        viewmat[:3, 3] = -pose @ middle + [-center[0], -center[1], away]
        focal = _FILLED * size / (2 * slope)
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, size, size, away * 1e-4)


def draw_card(card: Card, size: int = _CELL) -> list[Image.Image]:
    """Draw a mesh shaded, as a wireframe and textured: three images of size x size pixels."""
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
    paint = np.where(mesh.unobserved[hit][:, None], _UNOBSERVED, _CLAY)
    wires = _wires(mesh, camera, hit, rows, columns)[:, None]
    wired = (0.35 + 0.65 * light[:, None]) * paint * 1.12 * (1 - wires) + _WIRE * wires
    looks = [clay, wired]
    if card.texture is not None:
        looks.append(sample_texture(card.texture, np.einsum("nc,ncx->nx", weights, mesh.uvs[hit])))
    else:
        looks.append(np.einsum("nc,ncx->nx", weights, mesh.colors[corners]) / 255)
    return [_panel(drawn, look, size) for look in looks]


def _light(normals: np.ndarray) -> np.ndarray:
    """Shade normals (n, 3) in camera axes: a key light from the upper left, a fill light from the right, and sky."""
    key = np.clip(normals @ _unit(-0.55, -0.75, -0.75), 0, 1)
    fill = np.clip(normals @ _unit(0.9, -0.1, -0.5), 0, 1)
    sky = 0.5 - 0.5 * normals[:, 1]
    return np.clip(0.30 + 0.62 * key + 0.13 * fill + 0.14 * sky, 0, 1.15)


def _unit(*xyz: float) -> np.ndarray:
    return np.array(xyz) / np.linalg.norm(xyz)


def _wires(mesh: Mesh, camera: Camera, hit: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the fraction of each drawn pixel (n,) that is covered by an edge of its face, 0 .. 1."""
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


def _panel(drawn: np.ndarray, colors: np.ndarray, size: int) -> Image.Image:
    """Return the drawn pixels on the panel's background, reduced to size x size."""
    image = np.empty((*drawn.shape, 3), np.float32)
    image[:] = np.array(_PANEL) / 255
    image[drawn] = colors
    blocks = image.reshape(size, _FINER, size, _FINER, 3).mean((1, 3))
    return Image.fromarray(np.rint(np.clip(blocks, 0, 1) * 255).astype(np.uint8))


def mesh_sheet(cards: Sequence[Card], reporter: Reporter | None = None) -> Image.Image:
    """Arrange all cards in one image, each with name and figures above three panels; two columns from four cards on."""
    size = min(_CELL, int((_PIXELS / (3 * max(len(cards), 1))) ** 0.5))
    columns = 1 if len(cards) < 4 else 2
    gap, margin, gutter, head, below = 6, 24, 32, 38, 20
    name_font, font = load_font(16), load_font(12)
    wide = 3 * size + 2 * gap
    rows = -(-len(cards) // columns)
    top = margin + 22
    sheet = Image.new(
        "RGB", (2 * margin + columns * wide + (columns - 1) * gutter, top + rows * (head + size + below)), _PAPER
    )
    draw = ImageDraw.Draw(sheet)
    for column in range(columns):
        for k, text in enumerate(("surface", "wireframe, orange: unobserved", "texture")):
            x = margin + column * (wide + gutter) + k * (size + gap)
            draw.text((x, margin - 8), text, _FAINT, font)
    for place, card in enumerate(cards):
        x = margin + (place % columns) * (wide + gutter)
        y = top + (place // columns) * (head + size + below)
        draw.line((x, y, x + wide, y), (226, 226, 230), 1)
        draw.text((x, y + 11), shorten(card.name, name_font, wide * 0.45), _INK, name_font)
        figures = shorten(card.figures, font, wide * 0.55)
        draw.text((x + wide - font.getlength(figures), y + 14), figures, _FAINT, font)
        if reporter is not None:
            reporter.progress(place, len(cards), what="meshes")
        if card.mesh is None:
            draw.rounded_rectangle((x, y + head, x + wide - 1, y + head + size - 1), 6, _PANEL)
            text = shorten(card.why or "no mesh", font, wide - 40)
            draw.text((x + (wide - font.getlength(text)) / 2, y + head + size / 2 - 8), text, _FAINT, font)
            continue
        for k, image in enumerate(draw_card(card, size)):
            sheet.paste(image, (x + k * (size + gap), y + head), _rounded(size))
    if reporter is not None:
        reporter.progress(len(cards), len(cards), what="meshes")
    return sheet


def _rounded(size: int) -> Image.Image:
    mask = Image.new("L", (4 * size, 4 * size), 0)
    ImageDraw.Draw(mask).rounded_rectangle((0, 0, 4 * size - 1, 4 * size - 1), 24, 255)
    return mask.resize((size, size), Image.Resampling.LANCZOS)


def save_sheet(sheet: Image.Image, path: Path, limit: int = 300_000) -> Path:
    """Write `sheet` atomically as a PNG of at most `limit` bytes, with fewer colors or pixels if necessary."""
    image, scale = sheet, 1.0
    while True:
        buffer = io.BytesIO()
        image.save(buffer, "PNG", optimize=True)
        if buffer.tell() <= limit or min(image.size) < 64:
            write_atomic(path, buffer.getvalue())
            return path
        if image.mode == "P":
            scale *= min(0.95, (limit / buffer.tell()) ** 0.5)
        size = max(1, round(sheet.width * scale)), max(1, round(sheet.height * scale))
        smaller = sheet if size == sheet.size else sheet.resize(size, Image.Resampling.LANCZOS)
        image = _quantize(smaller)


def _quantize(image: Image.Image) -> Image.Image:
    """Reduce an image to 256 colors: the two background colors of the sheet exactly, and fitted ones for the rest."""
    pixels = np.asarray(image)
    # Every third row and column suffices. The exponent below 1 prevents frequent colors from displacing all others.
    found, count = np.unique(pixels[::3, ::3].reshape(-1, 3) >> 2, axis=0, return_counts=True)
    several = np.repeat(4 * found + 2, np.ceil(count**0.3).astype(int), axis=0).astype(np.uint8)
    fitted = Image.fromarray(several[None]).quantize(254, Image.Quantize.MEDIANCUT, kmeans=3)
    palette = Image.new("P", (1, 1))
    palette.putpalette([*_PAPER, *_PANEL, *(fitted.getpalette() or [])[: 3 * 254]])
    placed = np.array(image.quantize(palette=palette, dither=Image.Dither.NONE))
    # Pillow may map the background colors to similar ones.
    for place, own in enumerate((_PAPER, _PANEL)):
        placed[(pixels == own).all(2)] = place
    few = Image.fromarray(placed, "P")
    few.putpalette(palette.getpalette() or [])
    return few


def summarize_figures(figures: Mapping[str, Any]) -> str:
    """Return the most important figures of a mesh in one line."""
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
