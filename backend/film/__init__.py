"""Film frames of the splats: a shot file and a reconstruction become multilayer EXR files, one a frame.

`shot` says what a shot file holds (NumPy only, so that Blender's own Python can write one), `stage` puts the edited
splats of a moment together, `render` draws them, `cryptomatte` and `exr` are the formats.
"""
