# SPDX-License-Identifier: GPL-3.0-or-later
"""The backend's sentences with the names that Blender shows in place of the command line's options."""

from __future__ import annotations

import re

_NAMES = {
    "--capture": "Capture",
    "--detail": "Detail",
    "--detector": "Detection Model",
    "--frames": "Video Frames",
    "--max-size": "Image Size",
    "--minutes": "Minutes",
    "--mode": "Model",
    "--objects": "Objects",
    "--out": "Save To",
    "--restart": "Retrain",
    "--segmenter": "Segmentation Model",
    "--set": "Set",
    "--strategy": "Assignment",
    "--text": "Names",
}
"""Options, and the names of their properties or operators."""

_PHRASES = {
    "--mode explicit": "the Model Plain Splats",
    "use the same --keep and --leave-out": "set the check boxes of the panel Plan as they were",
    "try a smaller --max-size, --memory-mb or --max-anchors": "close other programs, or use a smaller Image Size",
    "a smaller --max-size or --max-anchors, or --device cpu": "a smaller Image Size",
    "a smaller --max-size or --max-anchors": "a smaller Image Size",
    "or use a smaller --memory-mb or --max-size": "or use a smaller Image Size",
    "--objects given keeps the IDs": "choose As Given for Objects to keep the IDs",
    "or use `masks`": "or use Import Masks",
    "which --text and --detector are for": "which Names is for",
    "choose a folder with one as MASKS": "clear Names, or choose a folder with one",
    "`clean-labels`": "Clean Up Labels",
    "`doctor`": "Check Backend",
    "do not tell its true size.": "do not tell its true size; Set Distance in the panel Placement gives it.",
}
"""Advice that has other words in Blender."""
_ONLY_TYPED = (
    " (on the command line: `sfm`)", ", or use the option --overwrite", ", or use --device cpu", " or --steps",
    ", a different --out", ", and `split` divides larger models into cells",
)  # fmt: skip
"""Advice that Blender has no property for."""
_FITS = re.compile(r"(?:--restart with )?--max-anchors \d+ fits")
"""Advice for which Blender has only the size of the photos."""

IMPORT_PHOTOS = "Import Photos or Video"
"""What the backend names where photos have no cameras yet."""

TRANSFORMERS = "transformers"
INSTALL = ("objectgs.install_transformers", "Install Transformers")
"""A package, the operator that installs it, and the label of its button."""

_OPTION = re.compile(r"(?<![\w`-])--[a-z]+(?:-[a-z]+)*(?![\w=-])")


def lacking(package: str, option: str) -> str:
    """Return what to say where an option of the backend needs a package that is not installed."""
    return f"{_NAMES.get(option, option)} needs the package {package}, which is not installed yet"


def in_blender(sentence: str) -> str:
    """Return a sentence of the backend with the names of Blender's properties for options that have one.

    A sentence with a command to be run in a terminal stays as it is.
    """
    if "pip install" in sentence:
        return sentence
    for phrase, shown in {**dict.fromkeys(_ONLY_TYPED, ""), **_PHRASES}.items():
        sentence = sentence.replace(phrase, shown)
    sentence = _FITS.sub("close other programs, or use a smaller Image Size and Retrain", sentence)
    return _OPTION.sub(lambda found: _NAMES.get(found.group(), found.group()), sentence)
