"""Simulation of one compiled scene: stepping, control, state, goals, rewards, observations, images."""
