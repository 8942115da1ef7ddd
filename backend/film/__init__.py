"""Film frames of splats: a shot file and a reconstruction become one multilayer EXR file for each frame.

`stage` provides the edited splats of a sample, `render` renders them, `cryptomatte` and `exr` write the formats.
"""
