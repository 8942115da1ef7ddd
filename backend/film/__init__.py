"""Film frames of splats: a shot file and a reconstruction become one multilayer EXR file for each frame.

`stage` combines the edited splats of a moment, `render` draws them, `cryptomatte` and `exr` write the formats.
"""
