"""The files of photos, videos and masks that captures are made of."""
