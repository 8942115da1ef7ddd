"""From splats to meshes, object by object: what each view sees of it -> signed distance -> surface -> UVs -> texture."""
