"""Floor 4: images of stars on the command line."""
