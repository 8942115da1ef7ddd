"""ObjectGS compute backend: captures, votes, splat training and evaluation, without Blender."""

__version__ = "0.1.0"
