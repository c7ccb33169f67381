"""From boxes in images to points in the arm's base frame."""
