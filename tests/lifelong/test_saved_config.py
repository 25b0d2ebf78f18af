"""config.yaml of a run is read as plain data; whatever else it holds is told in one line."""

import os

import pytest

from lifelong.errors import ConfigError
from lifelong.results.run_directory import read_saved_config

BOMB = "a: &a [1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"{b}: &{b} [{','.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefg", "bcdefgh", strict=True)
)


@pytest.mark.parametrize(("content", "said"), [
    (None, "No such file"),
    (b"\x93NUMPY\x00\xff", "not UTF-8"),
    (b"- 1\n- 2\n", "expected keys with values"),
    (b"", "expected keys with values"),
    (b"1: 2\n", "expected keys with values"),
    (b"seed: [1\n", "not valid YAML"),
    (b"!!python/object/apply:os.system ['true']\n", "not valid YAML"),
    (BOMB.encode(), "alias"),
])  # fmt: skip
def test_what_is_no_configuration_is_told_in_one_line(content, said, tmp_path):
    file = tmp_path / "config.yaml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ConfigError, match=said) as error:
        read_saved_config(file)
    assert str(file) in str(error.value) and "\n" not in str(error.value)


def test_pipes_and_devices_are_not_read(tmp_path):
    (tmp_path / "endless.yaml").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.yaml")
    for name in ("endless.yaml", "pipe.yaml", "."):
        with pytest.raises(ConfigError, match="is a folder, a pipe or a device"):
            read_saved_config(tmp_path / name)


def test_texts_are_not_resolved(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "hidden")
    (tmp_path / "config.yaml").write_text("seed: ${oc.env:SECRET}\n")
    assert read_saved_config(tmp_path / "config.yaml") == {"seed": "${oc.env:SECRET}"}
