"""Objects from strokes: the user marks objects in a few photos, and every splat gets the object it belongs to."""
