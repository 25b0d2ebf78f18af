"""Fixtures of the tests of the facade."""

import pytest


@pytest.fixture(autouse=True)
def no_configuration(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path_factory.getbasetemp() / "no-config"))
    # The facade would use the original's models where they are installed.
    monkeypatch.setenv("LIBERO_ASSETS", "builtin")


@pytest.fixture(scope="session")
def suite():
    from libero.libero import benchmark

    return benchmark.get_benchmark("libero_object")()


@pytest.fixture
def make_env(suite):
    """A factory of environments that are closed at the end."""
    from libero.libero.envs import ControlEnv

    made = []

    def make(cls=ControlEnv, task=0, **kwargs):
        made.append(cls(bddl_file_name=suite.get_task_bddl_file_path(task), **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture
def registries(monkeypatch):
    """Remove after the test what it registers: scenes, tasks, regions, objects and problem classes."""
    from libero.libero.envs import TASK_MAPPING
    from libero.libero.envs.base_object import OBJECTS_DICT
    from libero.libero.utils import mu_utils, object_utils, task_generation_utils
    from libero_env.objects import catalog

    monkeypatch.setattr(mu_utils, "MU_DICT", dict(mu_utils.MU_DICT))
    monkeypatch.setattr(mu_utils, "SCENE_DICT", {k: list(v) for k, v in mu_utils.SCENE_DICT.items()})
    monkeypatch.setattr(task_generation_utils, "TASK_INFO", {})
    monkeypatch.setattr(object_utils, "EXCEPTION_DICT", {})
    monkeypatch.setattr(catalog, "_registered", dict(catalog._registered))
    before = [(registry, dict(registry)) for registry in (OBJECTS_DICT, TASK_MAPPING)]
    yield
    for registry, entries in before:
        registry.clear()
        registry.update(entries)
