"""From splats to meshes, object by object: what views see of it -> signed distance -> surface -> UVs -> texture."""
