"""The subcommands of `libero` that evaluate and judge."""
