"""Plans: from a goal to steps, and from a step to a grasp and a place pose."""
