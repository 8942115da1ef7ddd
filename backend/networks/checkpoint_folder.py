"""Folders of the user with a checkpoint of the package transformers: config.json and weights. Nothing is downloaded."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from ..shared.errors import InputError, MissingPackage, is_lack_of_memory
from ..shared.formats.json_file import parse_json

PACKAGE = "transformers>=5,<6"
_MAJOR = "5"
_BUILDS = "https://download.pytorch.org/whl/"
"""Package indexes of the builds of torch and torchvision: those for CPUs, and for each version of CUDA."""
CONFIG = "config.json"
_WEIGHTS = ("*.safetensors", "*.bin")
"""Files with weights, of one of these kinds; of both, those of the first are used."""


def read_config(folder: Path, what: str, option: str) -> dict[str, Any]:
    """Read the config of a checkpoint.

    Args:
        folder: the folder of the checkpoint.
        what: the networks that are expected, for errors, such as "LightGlue".
        option: the argument of the command that names the folder, for errors.

    Returns:
        The content of config.json, with text as `model_type`.

    Raises:
        InputError: The folder lacks a file, or its config.json is not that of a model.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; choose one with a checkpoint of {what} as {option}.")
    path = folder / CONFIG
    if not path.is_file():
        raise InputError(f"{folder} has no {CONFIG}; choose a folder with a checkpoint of {what} as {option}.")
    if not _weights(folder):
        raise InputError(f"{folder} has no weights ({' or '.join(_WEIGHTS)}); copy those of {what} there, too.")
    try:
        config = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise not_a_config(path, what) from error
    if not isinstance(config, dict) or not isinstance(config.get("model_type"), str):
        raise not_a_config(path, what)
    return config


def not_a_config(path: Path, what: str) -> InputError:
    """Return the error for a config.json that cannot be understood."""
    return InputError(f"{path} is not the config of a model; copy the checkpoint of {what} again.")


def _unfit(folder: Path, why: str) -> InputError:
    """Return the error for weights that cannot be loaded."""
    return InputError(f"The weights in {folder} do not fit its {CONFIG} ({why}); copy the checkpoint again.")


def import_transformers(needed: str, option: str) -> Any:
    """Import the package transformers, silently.

    Args:
        needed: a class that it must have.
        option: the argument of the command that needs it, for the error.

    Raises:
        MissingPackage: It is not installed, or too old or new.
        InputError: It fails, since other packages do not fit it.
    """
    missing = MissingPackage(option, "transformers", _install(PACKAGE))
    try:
        transformers: Any = importlib.import_module("transformers")
        if transformers.__version__.partition(".")[0] != _MAJOR:
            raise missing
        getattr(transformers, needed)  # Imported when it is asked for.
    except MissingPackage:
        raise
    except Exception as error:  # What it imports may fail in any way.
        if isinstance(error, AttributeError) or getattr(error, "name", None) == "transformers":
            raise missing from error
        raise _broken(error) from error
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    return transformers


def _broken(error: Exception) -> InputError:
    """Return the error for packages that are installed and fail."""
    why = str(error.__cause__ or error).strip().partition("\n")[0].rstrip(".")
    return InputError(
        f"The package transformers of {sys.executable} cannot be loaded ({why}); set up the backend again, or remove "
        "the package that fails."
    )


def load_network(
    folder: Path, network: str, config: str, option: str, change: Callable[[Any], None] = lambda _config: None
) -> Any:
    """Load a network of transformers.

    Args:
        folder: the folder of the checkpoint.
        network, config: the classes of the network and of its config.
        option: the argument of the command that names the folder, for errors.
        change: called with the config, which it may change.

    Returns:
        The network on the CPU, in float32, for inference.

    Raises:
        InputError: The weights do not fit config.json, some are missing, there is not enough memory for them, or a
            package is not installed.
    """
    transformers = import_transformers(network, option)
    try:
        settings = getattr(transformers, config).from_pretrained(folder, local_files_only=True)
        change(settings)
        loaded, info = getattr(transformers, network).from_pretrained(
            folder, config=settings, dtype=torch.float32, local_files_only=True, output_loading_info=True
        )
    except ImportError as error:
        if importlib.util.find_spec("timm") is not None:
            raise _broken(error) from error
        raise InputError(
            f"The model in {folder} needs the package timm; run {install_timm()} in a terminal."
        ) from error
    except Exception as error:  # Files may be damaged in any way.
        if is_lack_of_memory(error):
            raise InputError(
                f"There is not enough memory for the model in {folder}; close other programs, or use a smaller model."
            ) from error
        raise _unfit(folder, str(error).strip().partition("\n")[0]) from error
    for kind in ("missing", "mismatched"):
        if names := sorted(map(str, info[f"{kind}_keys"])):
            raise _unfit(folder, f"{names[0]} is {kind}")
    return loaded.eval()


def read_tokenizer(folder: Path, what: str, option: str, files: Sequence[str]) -> Any:
    """Return the tokenizer of a checkpoint.

    Args:
        folder: the folder of the checkpoint.
        what: its network, for errors.
        option: the argument of the command that names the folder, for errors.
        files: those of which one is enough.

    Raises:
        InputError: They are missing or damaged, or a package is not installed.
    """
    if not any((folder / name).is_file() for name in files):
        raise InputError(f"{folder} has no {' or '.join(files)}; copy all files of the checkpoint of {what} there.")
    tokenizers = import_transformers("AutoTokenizer", option).AutoTokenizer
    try:
        return tokenizers.from_pretrained(folder, local_files_only=True)
    except Exception as error:  # Files may be damaged in any way.
        why = str(error).strip().partition("\n")[0]
        raise InputError(f"The tokenizer in {folder} cannot be read ({why}); copy the checkpoint again.") from error


def _install(package: str) -> str:
    """Return the command that installs a package for this Python, as PowerShell takes it, or another shell."""
    call = "& " if os.name == "nt" else ""
    return f'{call}"{sys.executable}" -m pip install "{package}"'


def install_timm() -> str:
    """Return the command that installs timm with the torchvision of this build of torch; others cannot be loaded."""
    build = torch.__version__.partition("+")[2]
    index = f" --extra-index-url {_BUILDS}{build}" if build else ""
    return f'{_install("timm")} "torch=={torch.__version__}"{index}'


def digest_of(folder: Path) -> str:
    """Return 8 hexadecimal digits that identify the files of a checkpoint; raises InputError if one is unreadable."""
    digest = hashlib.sha256()
    for path in (folder / CONFIG, *_weights(folder)):
        try:
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise InputError(f"{path} cannot be read ({error.strerror}); check its permissions.") from error
    return digest.hexdigest()[:8]


def _weights(folder: Path) -> list[Path]:
    return next((found for kind in _WEIGHTS if (found := sorted(folder.glob(kind)))), [])
