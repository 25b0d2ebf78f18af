"""The LIBERO benchmark in headless MuJoCo: tasks, objects, simulation, experts, demonstrations."""
