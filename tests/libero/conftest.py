"""Fixtures of the tests of the facade."""

import pytest


@pytest.fixture(autouse=True)
def no_configuration(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path_factory.getbasetemp() / "no-config"))
    # The facade would use the original's models where they are installed.
    monkeypatch.setenv("LIBERO_ASSETS", "builtin")
    monkeypatch.delenv("LIBERO_DRAWING", raising=False)


@pytest.fixture(scope="session")
def suite():
    from libero.libero import benchmark

    return benchmark.get_benchmark("libero_object")()


@pytest.fixture
def make_env(suite):
    """A factory of environments that are closed at the end."""
    from libero.libero.envs import ControlEnv

    made = []

    def make(cls=ControlEnv, file=None, **kwargs):
        made.append(cls(bddl_file_name=file or suite.get_task_bddl_file_path(0), **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()
