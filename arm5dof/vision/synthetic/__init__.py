"""Random tabletop scenes."""
