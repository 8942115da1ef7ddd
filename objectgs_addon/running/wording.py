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

_VALUES = {"--mode explicit": "the Model Plain Splats"}
"""Options with a value that has another name in Blender."""
_ONLY_TYPED = (" (on the command line: `sfm`)", ", or use the option --overwrite", " or --steps")
"""Advice that Blender has no property for."""

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
    for phrase, shown in {**dict.fromkeys(_ONLY_TYPED, ""), **_VALUES}.items():
        sentence = sentence.replace(phrase, shown)
    return _OPTION.sub(lambda found: _NAMES.get(found.group(), found.group()), sentence)
