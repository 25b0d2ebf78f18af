"""Can this CPU compute in bfloat16?"""

import subprocess
import sys
from functools import cache

import torch

_PROBE = """
import torch
torch.set_num_threads(1)
layer, x = torch.nn.Linear(384, 64), torch.randn(64, 384)
with torch.autocast("cpu", torch.bfloat16):
    layer(x).sum().backward()
"""


@cache
def bf16_runs_on_cpu() -> bool:
    """Whether bfloat16 is fast on this CPU and a bfloat16 product ends well.

    Some virtual machines announce AMX and then kill the process at its first instruction, so the product is
    tried in another process, which takes a few seconds, once. Where it fails, setting the environment
    variable ONEDNN_MAX_CPU_ISA=AVX512_CORE_BF16 before Python starts makes bfloat16 usable nevertheless.
    """
    if not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return False
    try:
        probe = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return probe.returncode == 0
