"""Perturbations of tasks and episodes: values that compose on one environment.

A perturbation has a kind, a severity in [0, 1] with a physical meaning, and a seed. Kinds act on one of five layers, in
this order: the problem (which becomes another task), the appearance, the start, the observation and the action. What a
kind samples is an absolute change, such as the pose of a camera, which can also be given to an environment as it is.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
