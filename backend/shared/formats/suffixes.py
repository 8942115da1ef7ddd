"""Suffixes of the files of photos and videos, in lower case."""

IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm"}
"""Images that a capture may contain."""
HEIC = {".heic", ".heif", ".hif", ".avif"}
"""Photos of phones."""
RAW = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"}
"""Unprocessed photos of cameras, which need the package rawpy."""
PHOTOS = IMAGES | HEIC | RAW
VIDEOS = {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".mpg", ".mpeg", ".wmv", ".3gp"}
