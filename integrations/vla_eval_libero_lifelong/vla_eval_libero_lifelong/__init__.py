"""vla-eval, the evaluation harness: our simulations as its benchmark, our runs as its model server.

vla-eval takes both as `module:Class`: `vla_eval_libero_lifelong.benchmark:LiberoBenchmark` and
`vla_eval_libero_lifelong.server:RunServer`.
"""
