"""Simulation of one compiled scene: stepping, control, state, truth of goals, rewards, observations, images."""
