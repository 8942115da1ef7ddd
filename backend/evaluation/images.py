"""Images for reports and previews: renders beside photos, object IDs in color, contact sheets."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ..shared.color.palette import colors_of, object_colors
from ..shared.durations import clock
from ..shared.formats.atomic import write_atomic
from ..shared.reconstruction.objects import default_name

Colors = Mapping[int, Sequence[int]]

PANEL_WIDTH = 480
CELL_WIDTH = 320
MARGIN = 16
GAP = 10
LEGEND_ENTRIES = 18
PAPER = (255, 255, 255)
INK = (38, 38, 42)
FAINT_INK = (118, 118, 124)
RULE = (214, 214, 218)


CURVE_SIZE = (320, 240)
CURVE_PAPER, CURVE_INK, CURVE_LINE = (40, 40, 42), (200, 200, 204), (94, 160, 250)

_SHOWN = 12
"""Largest number of photos in a picture of masks."""


def load_font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size)


def as_bytes(image: NDArray) -> NDArray[np.uint8]:
    """Convert an image (h, w, 3), float in [0, 1] or uint8, to uint8; NaN and Inf become 0."""
    if image.dtype == np.uint8:
        return image
    return np.rint(255.0 * np.clip(np.nan_to_num(image, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)).astype(np.uint8)


def id_image(ids: NDArray, colors: Colors | None = None) -> NDArray[np.uint8]:
    """Color an ID map (h, w) as an image (h, w, 3) uint8; IDs without an entry in `colors` get the palette's color."""
    found, inverse = np.unique(ids, return_inverse=True)
    table = colors_of(found)
    if colors:
        for row, i in enumerate(found.tolist()):
            table[row] = colors.get(i, table[row])
    return table[inverse.reshape(ids.shape)]


def comparison(
    truth: NDArray,
    render: NDArray,
    true_ids: NDArray | None,
    ids: NDArray,
    colors: Colors | None = None,
    names: Mapping[int, str] | None = None,
    title: str = "",
) -> Image.Image:
    """Arrange a photo, its render, the rendered IDs and the mask's IDs side by side, with a legend of the objects.

    Args:
        truth: The photo, (h, w, 3), uint8 or float in [0, 1].
        render: The render of the same view, in the format of `truth`.
        true_ids: The object IDs of the mask, (h, w); None omits this panel.
        ids: The rendered object IDs, (h, w).
        colors: Object ID -> (red, green, blue), 0 .. 255, for objects with a color other than the palette's.
        names: Object ID -> name for the legend.
        title: A heading above the panels.
    """
    size = _fit(truth.shape[1], truth.shape[0])
    panels = [
        ("Photo", _resized(as_bytes(truth), size, Image.Resampling.LANCZOS)),
        ("Render", _resized(as_bytes(render), size, Image.Resampling.LANCZOS)),
        ("Rendered IDs", _resized(id_image(ids, colors), size, Image.Resampling.NEAREST)),
    ]
    if true_ids is not None:
        panels.append(("Mask IDs", _resized(id_image(true_ids, colors), size, Image.Resampling.NEAREST)))
    legend = _legend_entries(ids if true_ids is None else np.concatenate([ids, true_ids]), colors, names)
    return _sheet(panels, len(panels), title, legend)


def curve_image(curve: Sequence[Mapping[str, Any]]) -> Image.Image | None:
    """Draw the PSNR over the run time as a small image for a dark panel; None if there are fewer than two measurements.

    It is drawn without matplotlib, in a few milliseconds, since it delays the training.
    """
    found = [(float(entry["seconds"]), float(entry["psnr"])) for entry in curve if entry.get("psnr") is not None]
    if len(found) < 2:
        return None
    width, height = CURVE_SIZE
    left, top, right, bottom = 34, 22, width - 10, height - 24
    seconds, values = np.array(found).T
    low, high = math.floor(values.min()), math.ceil(values.max() + 0.01)
    image = Image.new("RGB", CURVE_SIZE, CURVE_PAPER)
    pen = ImageDraw.Draw(image)

    def place(second: float, value: float) -> tuple[float, float]:
        return (
            left + (right - left) * second / max(seconds[-1], 1e-9),
            bottom - (bottom - top) * (value - low) / (high - low),
        )

    for value in range(low, high + 1, max(1, (high - low) // 4)):
        y = place(0.0, value)[1]
        pen.line([(left, y), (right, y)], fill=(70, 70, 74))
        pen.text((left - 6, y), str(value), fill=CURVE_INK, font=load_font(12), anchor="rm")
    pen.line([place(*point) for point in found], fill=CURVE_LINE, width=3, joint="curve")
    pen.text((left, 4), "PSNR of held-out views, dB", fill=CURVE_INK, font=load_font(12))
    pen.text((right, bottom + 6), clock(seconds[-1]), fill=CURVE_INK, font=load_font(12), anchor="ra")
    return image


def thumbnail(image: NDArray, longest: int = 256) -> Image.Image:
    """Reduce an image (h, w, 3), uint8 or float in [0, 1], to at most `longest` pixels on its longer side."""
    size = _fit(image.shape[1], image.shape[0], longest)
    return _resized(as_bytes(image), size, Image.Resampling.LANCZOS)


def contact_sheet(
    images: Sequence[NDArray | Image.Image],
    titles: Sequence[str],
    columns: int = 4,
    ids: NDArray | None = None,
    names: Mapping[int, str] | None = None,
) -> Image.Image:
    """Arrange images in rows of `columns`, each below its title, scaled to fit the size of the first one.

    Args:
        images, titles: The images, (h, w, 3), and their titles.
        columns: Number of images in a row.
        ids: The object IDs of all pixels, of any shape, for a legend with the palette's colors; None omits it.
        names: Object ID -> name for the legend.

    Raises:
        ValueError: There are no images.
    """
    if not images:
        raise ValueError("a contact sheet needs at least one image")
    converted = [
        image.convert("RGB") if isinstance(image, Image.Image) else Image.fromarray(as_bytes(image)) for image in images
    ]
    size = _fit(*converted[0].size, CELL_WIDTH)
    cells = []
    for image, title in zip(converted, titles):
        scale = min(size[0] / image.width, size[1] / image.height)
        fitted = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
        cells.append((title, image.resize(fitted, Image.Resampling.LANCZOS)))
    legend = [] if ids is None else _legend_entries(ids, None, names)
    return _sheet(cells, min(columns, len(cells)), "", legend)


class MaskSheet:
    """Collects the masks of photos one by one, of which some are shown.

    Args:
        count: number of the photos to come.

    Attributes:
        photos: number of photos so far that show an object.
        photos_of: the same of each object by its ID.
    """

    def __init__(self, count: int) -> None:
        self._every, self._added = max(count // _SHOWN, 1), 0
        self._cells: list[tuple[str, NDArray]] = []
        self._ids: list[NDArray] = []
        self.photos = 0
        self.photos_of: Counter[int] = Counter()

    def add(self, title: str, mask: NDArray, photo: Callable[[], NDArray]) -> None:
        """Add the mask (h, w) of a photo, 0 for no object; `photo` returns its pixels (H, W, 3) if it is shown."""
        present = np.unique(mask[mask > 0]).tolist()
        self.photos += bool(present)
        self.photos_of.update(present)
        if self._added % self._every == 0 and len(self._cells) < _SHOWN:
            image = np.asarray(thumbnail(photo(), PANEL_WIDTH), np.float64)
            rows, columns = (np.linspace(0, old - 1, new).astype(int) for old, new in zip(mask.shape, image.shape))
            ids = mask[np.ix_(rows, columns)]
            mixed = np.where((ids > 0)[..., None], 0.45 * image + 0.55 * id_image(ids), image)
            self._cells.append((title, mixed.astype(np.uint8)))
            self._ids.append(ids[ids > 0])
        self._added += 1

    def summary(self, of: str = "photos") -> str:
        """Return how many objects there are, and in how many photos, or other views that `of` names, of all."""
        count = len(self.photos_of)
        return f"{count:,} object{'' if count == 1 else 's'} in {self.photos} of {self._added} {of}"

    def save(self, path: Path, names: Mapping[int, str]) -> None:
        """Write the picture as a JPEG, with the names of the objects by ID."""
        titles, images = zip(*self._cells, strict=True)
        buffer = io.BytesIO()
        contact_sheet(images, titles, ids=np.concatenate(self._ids), names=names).save(buffer, "JPEG", quality=88)
        write_atomic(path, buffer.getvalue())


def save_image(image: Image.Image, path: Path, limit: int = 300_000, quick: bool = False) -> Path:
    """Write an image atomically as PNG, or as JPEG if the PNG has more than `limit` bytes.

    Args:
        image: The image to write.
        path: The file to write, with the suffix .png.
        limit: The largest size of the PNG in bytes.
        quick: Compress less, in a fifth of the time, for temporary images.

    Returns:
        The path of the file; its suffix is .jpg if it is a JPEG.
    """
    buffer = io.BytesIO()
    image.save(buffer, "PNG", **({"compress_level": 1} if quick else {"optimize": True}))
    if buffer.tell() > limit:
        path = path.with_suffix(".jpg")
        for quality in (92, 86, 78, 68):
            buffer = io.BytesIO()
            image.convert("RGB").save(buffer, "JPEG", quality=quality, subsampling=0, optimize=True)
            if buffer.tell() <= limit:
                break
    write_atomic(path, buffer.getvalue())
    return path


def _fit(width: int, height: int, longest: int = PANEL_WIDTH) -> tuple[int, int]:
    """Return the size of a panel: as large as the image, up to `longest` pixels on the longer side."""
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _resized(pixels: NDArray[np.uint8], size: tuple[int, int], how: Image.Resampling) -> Image.Image:
    image = Image.fromarray(pixels)
    return image if image.size == size else image.resize(size, how)


_Legend = list[tuple[tuple[int, int, int] | None, str]]


def _legend_entries(ids: NDArray, colors: Colors | None, names: Mapping[int, str] | None) -> _Legend:
    """Return (color, name) of the visible objects, largest first, then the number left out, then "no object"."""
    found, counts = np.unique(ids, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    shown = [int(i) for i in found[order] if i != 0]
    entries: _Legend = []
    for i in shown[:LEGEND_ENTRIES]:
        r, g, b = id_image(np.array([[i]]), colors)[0, 0].tolist()
        entries.append(((r, g, b), (names or {}).get(i) or default_name(i)))
    if len(shown) > LEGEND_ENTRIES:
        entries.append((None, f"and {len(shown) - LEGEND_ENTRIES} more"))
    if len(shown) < len(found):
        entries.append((object_colors([0])[0], "no object"))
    return entries


def _sheet(cells: Sequence[tuple[str, Image.Image]], columns: int, title: str, legend: _Legend) -> Image.Image:
    """Arrange cells in a grid below their titles, with a heading and a legend."""
    size = cells[0][1].size
    label_size = 14 if size[0] >= 200 else 11
    label, heading = load_font(label_size), load_font(label_size + 3)
    label_height = label_size + 9
    rows = -(-len(cells) // columns)
    width = 2 * MARGIN + columns * size[0] + (columns - 1) * GAP
    top = MARGIN + (label_size + 15 if title else 0)
    bottom = top + rows * (label_height + size[1]) + (rows - 1) * GAP
    lines = _legend_lines(legend, label, width - 2 * MARGIN, label_size)
    line_height = label_size + 10
    height = bottom + (GAP + 2 + len(lines) * line_height - 8 if lines else 0) + MARGIN

    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    if title:
        draw.text((MARGIN, MARGIN - 2), shorten(title, heading, width - 2 * MARGIN), INK, heading)
    for i, (text, image) in enumerate(cells):
        x = MARGIN + (i % columns) * (size[0] + GAP)
        y = top + (i // columns) * (label_height + size[1] + GAP)
        draw.text((x, y), shorten(text, label, size[0]), FAINT_INK, label)
        sheet.paste(image, (x + (size[0] - image.width) // 2, y + label_height))
    swatch = label_size - 2
    y = bottom + GAP + 2
    for line in lines:
        for x, color, text in line:
            left = MARGIN + x
            if color is not None:
                draw.rounded_rectangle((left, y + 2, left + swatch, y + 2 + swatch), 3, color, RULE)
                left += swatch + 6
            draw.text((left, y), text, INK if color is not None else FAINT_INK, label)
        y += line_height
    return sheet


def _legend_lines(legend: _Legend, font: Any, width: int, size: int) -> list[list[tuple[int, tuple | None, str]]]:
    """Break legend entries (x, color, text) into lines that are at most `width` pixels wide."""
    lines: list[list[tuple[int, tuple | None, str]]] = []
    x = width + 1
    for color, text in legend:
        text = shorten(text, font, 220)
        needed = round(font.getlength(text)) + (size + 4 if color is not None else 0)
        if x + needed > width:
            lines.append([])
            x = 0
        lines[-1].append((x, color, text))
        x += needed + 20
    return lines


def shorten(text: str, font: Any, width: float) -> str:
    """Truncate `text` with an ellipsis to at most `width` pixels."""
    whole = len(text)
    # Fonts refuse to measure long texts, and a character is at least a pixel wide.
    text = "".join(c if c.isprintable() else " " for c in text[: int(width) + 1])
    if len(text) == whole and font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "...") > width:
        text = text[:-1]
    return text + "..."
