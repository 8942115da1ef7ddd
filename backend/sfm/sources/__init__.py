"""Where the photos come from: folders, files in all formats, and frames of videos."""
