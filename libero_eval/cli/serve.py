"""`libero serve`: a run's policy for clients in openpi's protocol."""

import argparse
import asyncio
import contextlib

from libero_env.cli import arguments
from libero_eval.cli import options


def register(subparsers: "argparse._SubParsersAction") -> None:
    """Add the command `libero serve RUN`."""
    parser = subparsers.add_parser("serve", help="serve a run's policy in openpi's WebSocket protocol")
    options.add_run(parser)
    options.add_after(parser)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument(
        "--port",
        type=arguments.whole(0, 65535),
        default=8000,
        help="port to listen on, 0 for a free one (default: 8000)",
    )
    parser.add_argument(
        "--seed",
        type=arguments.seed,
        default=0,
        help="seed of stochastic policies, for clients that send none (default: 0)",
    )
    options.add_loading(parser)
    parser.add_argument(
        "--policy-threads",
        type=arguments.processes,
        default=1,
        metavar="N",
        help="threads of a policy on the CPU, as of `libero eval` (default: 1)",
    )
    parser.set_defaults(run=run_serve)


def run_serve(args: argparse.Namespace) -> None:
    """Serve until interrupted; the address is printed once clients are accepted."""
    import torch

    from libero_eval.servers.serving import PolicyServer
    from libero_eval.servers.sessions import ServedPolicy
    from lifelong.evaluation.restore import restore

    served = ServedPolicy(
        restore(args.policy, after=args.after, device=args.device, allow=args.allow), seed=args.seed
    )
    if served.run.device.type == "cpu":
        torch.set_num_threads(args.policy_threads)
    server = PolicyServer(served.metadata, served.session, host=args.host, port=args.port)

    def ready(port: int) -> None:
        print(f"serving {args.policy} after task {served.run.learned} at ws://{args.host}:{port}", flush=True)

    with contextlib.suppress(asyncio.CancelledError):
        asyncio.run(server.run(ready))
