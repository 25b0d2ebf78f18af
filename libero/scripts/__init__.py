"""The original's command line scripts, each with `main(argv)`; `scripts/` and `benchmark_scripts/` run them."""
