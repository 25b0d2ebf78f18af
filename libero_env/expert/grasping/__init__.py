"""Where to grasp a body: from above, by a wall, by a handle."""
