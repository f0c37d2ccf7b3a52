"""The commands that take a file of many options: from footage to a scene, an animator's tools, both on many clips."""
