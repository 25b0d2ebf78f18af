"""The subcommands of `libero` that need no learning: tasks, demos, objects, assets, teleop."""
