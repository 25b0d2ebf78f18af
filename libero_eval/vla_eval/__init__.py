"""vla-eval, the evaluation harness: our simulations as its benchmark, our runs as its model server.

Neither needs a change of vla-eval, which takes both as `module:Class`. The modules are imported in its environment;
`benchmark` needs no PyTorch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
