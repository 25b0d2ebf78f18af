"""What to do next: goal to steps, pick plans, poses for placing."""
