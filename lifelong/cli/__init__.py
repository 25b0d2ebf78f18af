"""The `libero` command: the subcommands of `libero_env.cli`, and those that evaluate and report."""
