"""The names that packages offer: what users import, loaded when it is first used."""

import importlib
import json
import pkgutil
import subprocess
import sys

import pytest

import libero_env
import libero_eval
import lifelong

OFFERED = {
    "libero_env": {*("BatchEnv", "Camera", "Expert", "LiberoEnv", "LiberoError", "Suite", "Task",
     "UnknownNameError"), *("ensure_demos", "get_suite", "get_task", "make_task", "read_demos", "read_task"),
     *("register_object", "register_predicate")},
    "lifelong": {*("Algorithm", "Batch", "EvalSettings", "FitSettings", "LifelongError", "Policy", "PolicySpec"),
     *("fit", "lifelong_metrics", "load_runs", "rollout", "write_report")},
    "libero_eval": {*("Comparison", "EvalProtocol", "EvalRequest", "EvaluationResult", "TaskResult"),
     *("compare_groups", "evaluate", "load_protocol")},
}  # fmt: skip
PACKAGES = sorted(
    module.name
    for root in (libero_env, lifelong, libero_eval)
    for module in pkgutil.walk_packages(root.__path__, f"{root.__name__}.")
    if module.ispkg
)


@pytest.mark.parametrize("package", [*OFFERED, *PACKAGES])
def test_every_offered_name_exists(package):
    module = importlib.import_module(package)
    assert package not in OFFERED or OFFERED[package] == set(module.__all__) == set(dir(module))
    for name in getattr(module, "__all__", ()):
        assert getattr(module, name) is not None
        assert not isinstance(getattr(module, name), type(sys)), f"{package}.{name} is a module"


@pytest.mark.parametrize("package", OFFERED)
def test_importing_a_package_loads_nothing_heavy(package):
    code = f"import json, sys, {package}; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"mujoco", "torch", "numpy", "h5py", "hydra"} & set(json.loads(done.stdout))


def test_a_name_that_does_not_exist_is_refused():
    with pytest.raises(ImportError, match="LiberoEvn"):
        from libero_env import LiberoEvn  # noqa: F401
    with pytest.raises(AttributeError, match="nothing"):
        _ = lifelong.nothing  # type: ignore[attr-defined]
