"""Teleoperation: demonstrations that a user records with a keyboard or a 3D mouse."""
