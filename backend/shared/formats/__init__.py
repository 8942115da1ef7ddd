"""Files in general: atomic writes, JSON, PLY tables and mesh PLY."""
