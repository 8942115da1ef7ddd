"""Random damage to the content of files, by format."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
from safetensors.numpy import load, save

NUMBERS = ("0", "-1", "-0.0", "1e-320", "1e-30", "1e30", "1e300", "1e308", "1e999", "-1e308", "nan", "inf", "-inf",
           "65535", "4294967295", "4294967296", "9223372036854775807", "18446744073709551615", "9" * 5000, "0x10",
           "1_0", "", "x", "\u0663")  # fmt: skip
"""Words that are read as numbers, or are not."""
DOUBLES = (0.0, -0.0, float("nan"), float("inf"), -float("inf"), 1e300, 1e308, -1e308, 1e-320, 1e30, -1.0, 1e12)
INTEGERS = (0, 1, 0xFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)
TEXTS = ("", " ", "CON", "..", "../../x", "/etc/passwd", "a/b\\c", "\0", "\n", "\ud800", "\u202e", "e\u0301", "x" * 300,
         "x" * 1_000_000, "{}", "%s%n", "-1", "nan")  # fmt: skip
_RAW = ("NaN", "Infinity", "-Infinity", "1e999", "9" * 5000, "[" * 100_000, '{"a":' * 100_000, "1e308", "-0", "truth")
"""Texts put into JSON as they are."""


def mutate_bytes(data: bytes, rng: random.Random) -> bytes:
    """Change a few bytes, cut, repeat, insert or empty the content."""
    size = len(data)
    at, length = rng.randrange(size + 1), rng.choice((1, 2, 4, 8, 64, 1000))
    kind = rng.randrange(9)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + rng.randbytes(length) + data[at + length :]
    if kind == 2:
        return data[:at] + bytes(length) + data[at + length :]
    if kind == 3:
        return data[:at] + struct.pack("<Q", rng.choice(INTEGERS)) + data[at + 8 :]
    if kind == 4:
        return data[:at] + struct.pack("<d", rng.choice(DOUBLES)) + data[at + 8 :]
    if kind == 5:
        return data[:at] + data[max(at - length, 0) : at] + data[at:]
    if kind == 6:
        return data[:at] + data[at + length :]
    if kind == 7:
        return rng.choice((b"", rng.randbytes(length), data + rng.randbytes(length)))
    changed = bytearray(data)
    for _ in range(min(size, rng.choice((1, 3, 20)))):
        changed[rng.randrange(size)] = rng.randrange(256)
    return bytes(changed)


def mutate_text(data: bytes, rng: random.Random) -> bytes:
    """Change a word or a line of a text file, or its bytes."""
    lines = data.decode("utf-8", "replace").split("\n")
    at = rng.randrange(len(lines))
    kind = rng.randrange(7)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, lines[rng.randrange(len(lines))])
    elif kind == 2:
        lines[at] = rng.choice(TEXTS)
    elif kind in (3, 4, 5) and lines[at].split():
        words = lines[at].split(" ")
        words[rng.randrange(len(words))] = rng.choice(NUMBERS)
        lines[at] = " ".join(words)
    else:
        return mutate_bytes(data, rng)
    return "\n".join(lines).encode("utf-8", "replace")


def mutate_json(data: bytes, rng: random.Random) -> bytes:
    """Replace, remove, rename or add a value of a JSON file, or damage its text."""
    if rng.random() < 0.15:
        return mutate_bytes(data, rng)
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):  # It was damaged before.
        return mutate_bytes(data, rng)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        value = _changed(value, rng)
    raw = [rng.choice(_RAW), "@raw@"]
    text = json.dumps(value)
    return text.replace(f'"{raw[1]}"', raw[0], 1).encode("utf-8")


def _changed(value: Any, rng: random.Random) -> Any:
    """Return the value with one node, found by a random walk from the root, changed."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = rng.choice(sorted(value))
        kind = rng.random()
        if kind < 0.1:
            return {other: entry for other, entry in value.items() if other != key}
        if kind < 0.2:
            return {(rng.choice(TEXTS[:-5]) if other == key else other): entry for other, entry in value.items()}
        return {**value, key: _changed(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.85:
        at = rng.randrange(len(value))
        kind = rng.random()
        if kind < 0.1:
            return value[:at] + value[at + 1 :]
        if kind < 0.2:
            return [*value, value[at]]
        return [_changed(entry, rng) if i == at else entry for i, entry in enumerate(value)]
    plain = [
        None,
        True,
        False,
        0,
        -1,
        1,
        0.5,
        1e300,
        -1e308,
        2**31,
        2**32,
        2**63,
        2**64,
        [],
        {},
        [[]],
        "@raw@",
        "@raw@",
    ]
    return rng.choice([*plain, *TEXTS, [value], {"a": value}, str(value)])


def mutate_arrays(data: bytes, rng: random.Random) -> bytes:
    """Change a tensor or the state of a safetensors file, which stays a valid file, or damage its bytes."""
    try:
        load(data)
    except Exception:  # It was damaged before.
        return mutate_bytes(data, rng)
    kind = rng.random()
    if kind < 0.3:
        (size,) = struct.unpack("<Q", data[:8])
        header = mutate_json(data[8 : 8 + size], rng)
        return struct.pack("<Q", len(header)) + header + data[8 + size :]
    if kind < 0.4:
        return mutate_bytes(data, rng)
    (size,) = struct.unpack("<Q", data[:8])
    metadata = json.loads(data[8 : 8 + size]).get("__metadata__")
    tensors = load(data)
    if kind < 0.65:
        metadata = {"state": mutate_json(metadata["state"].encode(), rng).decode("utf-8", "replace")}
        return save(tensors, metadata)
    name = rng.choice(sorted(tensors))
    tensor = tensors[name].copy()
    change = rng.randrange(6)
    if change == 0:
        del tensors[name]
        return save(tensors, metadata)
    if change == 1 and tensor.size:
        tensor.flat[rng.randrange(tensor.size)] = _entry(tensor.dtype, rng)
    elif change == 2:
        tensor = np.full_like(tensor, _entry(tensor.dtype, rng))
    elif change == 3:
        tensor = tensor[:-1] if tensor.ndim else tensor[None]
    elif change == 4:
        tensor = tensor.astype(rng.choice([np.float64, np.float32, np.float16, np.int64, np.int32, np.uint8, np.bool_]))
    else:
        tensor = np.ascontiguousarray(tensor.T)[..., None] if rng.random() < 0.5 else tensor.reshape(-1)
    tensors[name] = np.ascontiguousarray(tensor)
    return save(tensors, metadata)


def _entry(dtype: np.dtype, rng: random.Random) -> Any:
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return np.float64(rng.choice(DOUBLES)).astype(dtype)
    limits = np.iinfo(dtype) if dtype.kind in "iu" else None
    return rng.choice([0, 1] if limits is None else [0, 1, int(limits.min), int(limits.max)])


def mutate_ply(data: bytes, rng: random.Random) -> bytes:
    """Change the header of a PLY file, a number of its data, or its bytes."""
    end = data.find(b"end_header\n") + len(b"end_header\n")
    kind = rng.random()
    if kind < 0.4:
        return mutate_text(data[:end], rng) + data[end:]
    if kind < 0.5:
        # Spherical harmonics of degree 31, and as much data.
        extra = "".join(f"property float f_rest_{i}\n" for i in range(45, 3 * (32**2 - 1))).encode()
        return data[:end].replace(b"property float opacity", extra + b"property float opacity") + data[end:]
    if kind < 0.85 and len(data) - end > 8:
        for _ in range(rng.choice((1, 1, 5, 200))):
            at = end + 4 * rng.randrange((len(data) - end) // 4)
            with np.errstate(over="ignore"):
                data = data[:at] + np.float32(rng.choice(DOUBLES)).tobytes() + data[at + 4 :]
        return data
    return mutate_bytes(data, rng)


def mutate_image(data: bytes, rng: random.Random) -> bytes:
    """Replace an image by one of another size, mode or format, by a decompression bomb, or damage its bytes."""
    from PIL import Image

    kind = rng.randrange(8)
    if kind < 2:
        return mutate_bytes(data, rng)
    if kind == 2:
        return png_bomb(*rng.choice(((30_000, 30_000), (1, 4_000_000), (60_000, 1_000))))
    if kind == 3:
        return rng.choice((npz_bomb(1 << 28), b"\x93NUMPY" + rng.randbytes(60), b"GIF89a", b"\xff\xd8\xff\xe0"))
    try:
        opened = Image.open(io.BytesIO(data))
        opened.load()
    except Exception:  # It was damaged before.
        return mutate_bytes(data, rng)
    with opened as image:
        if kind in (4, 5):
            size = rng.choice(((1, 1), (1, image.height), (image.width, image.height + 1), (image.height, image.width)))
            image = image.resize(size)
        mode = rng.choice(("1", "L", "LA", "P", "RGB", "RGBA", "I;16", "CMYK", "F"))
        image = image.convert("L").convert(mode) if mode in ("I;16", "F") else image.convert(mode)
    buffer = io.BytesIO()
    fitting = {"F": ["TIFF"], "CMYK": ["TIFF", "JPEG"], "I;16": ["PNG", "TIFF"], "LA": ["PNG"], "RGBA": ["PNG", "WEBP"]}
    image.save(buffer, rng.choice(fitting.get(mode, ["PNG", "TIFF", "GIF" if mode in "LP" else "PNG"])))
    return buffer.getvalue()


def png_bomb(width: int, height: int) -> bytes:
    """Return a small PNG, 8-bit gray, that decodes to `width` x `height` zeros."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(width + 1)) for _ in range(min(height, 30_000))) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def npz_bomb(entries: int) -> bytes:
    """Return a small .npz whose array `ids` has this number of entries, all 0, of 8 bytes; at most 512 MB are there."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<i8", "fortran_order": False, "shape": (1, entries)})
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("ids.npy", "w") as file:
        file.write(header.getvalue())
        for _ in range(min(8 * entries >> 24, 32)):
            file.write(bytes(1 << 24))
    return buffer.getvalue()


def mutation_for(name: str) -> Callable[[bytes, random.Random], bytes]:
    """Return the mutation for a file by its name."""
    suffix = name.rsplit(".", 1)[-1].lower()
    return {
        "json": mutate_json, "txt": mutate_text, "md": mutate_text, "ply": mutate_ply, "png": mutate_image,
        "safetensors": mutate_arrays,
    }.get(suffix, mutate_bytes)  # fmt: skip
