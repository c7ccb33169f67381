"""Training the tabletop detector from nothing."""
