"""See, decide, pick, place: tabletop scenes in which objects can be grasped, and robots that grasp them."""
