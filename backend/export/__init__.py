"""Import and export of splats in the formats of other programs."""

from .anchors import write_anchors
from .background import background_sphere
from .fit import agreement, fit_splats
from .foreign import read_foreign_scene, read_foreign_splats
from .gltf import write_gltf
from .levels import coarser_splats
from .model_splats import ExactSplats, FittedSplats, ModelSplats
from .ply import read_splats, splat_table, write_splat_parts, write_splats
from .splat import read_splat, write_splat
from .spz import DOWN_TO_UP, read_spz, write_spz
from .usd import write_usd

__all__ = [
    "DOWN_TO_UP", "ExactSplats", "FittedSplats", "ModelSplats", "agreement", "background_sphere", "coarser_splats",
    "fit_splats", "read_foreign_scene", "read_foreign_splats", "read_splat", "read_splats", "read_spz", "splat_table",
    "write_anchors", "write_gltf", "write_splat", "write_splat_parts", "write_splats", "write_spz", "write_usd",
]  # fmt: skip
