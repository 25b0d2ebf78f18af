"""Policies of LeRobot, such as ACT and diffusion policies, learned by libero-lifelong."""
