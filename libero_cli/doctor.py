"""`libero doctor`: what this machine has and lacks."""

from dataclasses import asdict

from libero_env import health
from libero_env.cli.options import Answer
from libero_env.errors import InvalidInputError
from libero_env.health import Finding
from lifelong.cli import runs


def doctor(*, gl: bool = False, gpu: bool = False) -> Answer:
    """Say what this machine has and lacks, and how to fix it; return 1 where something essential is broken.

    Args:
        gl: Only draw a frame.
        gpu: Only check the GPU, some minutes: driver, renderers that draw at once, MuJoCo Warp, PyTorch; 1 is returned
            where there is none.
    """
    if gl and gpu:
        raise InvalidInputError("--gl and --gpu each check one thing only; give one of them")
    if gl:
        findings = [health.check_gl()]
    elif gpu:
        findings = examine_gpu()
    else:
        findings = [*health.examine(), *runs.examine()]
    rows, broken = [], False
    for finding in findings:
        mark = "ok  " if finding.ok else ("FAIL" if finding.essential else "note")
        rows.append(f"{mark}  {finding.title + ':':27} {finding.detail}")
        rows += [] if finding.ok else [f"      -> {finding.remedy}"]
        broken |= mark == "FAIL"
    content = {"ok": not broken, "findings": [asdict(finding) for finding in findings]}
    return Answer("\n".join(rows), content, status=int(broken))


def examine_gpu() -> list[Finding]:
    """Return the findings about the GPU: of the benchmark, and of PyTorch."""
    if not (name := health.gpu_name()):
        remedy = "install the driver; everything runs without a GPU, too"
        return [Finding("GPU", "nvidia-smi finds none", False, remedy)]
    found = health.examine_gpu(name)
    if not runs.check_torch().ok:
        return [*found, runs.check_torch()]
    from lifelong.cli import gpu

    return [*found, *gpu.examine()]
