"""How commands end: whose fault an error is, which status it gives, and what signals leave behind."""

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest

from libero_cli import main as cli
from libero_env import memory, mujoco_compat
from libero_env.cli import ending
from libero_env.curating.video import Mp4Writer
from libero_env.errors import DEBUG_VARIABLE, LiberoError, RenderError, code_of
from libero_env.parallel import spawn_pool
from libero_env.storage import atomic_path
from libero_env.tasks import get_task
from libero_eval.protocols.files import load_protocol
from libero_eval.work.evaluation import Evaluation
from lifelong import launch

ROOT = Path(__file__).parents[1]
PATIENCE = 60.0  # s; for a process to start or to end

POLICY = """
import time
import numpy as np

class Policy:
    cameras, camera_size = ("agentview",), (16, 16)

    def __init__(self, act):
        self.act = act

    def predict(self, observations):
        return self.act(observations)

def zeros(observations):
    return np.zeros((len(observations["agentview_rgb"]), 7))

def fails(observations):
    raise ValueError("no such weights\\x1b[2J")

def slow(observations):
    open("started", "a").close()
    time.sleep(0.2)
    return zeros(observations)

def make():
    return Policy(zeros)

def failing():
    return Policy(fails)

def waiting():
    return Policy(slow)

def texts():
    return Policy(lambda observations: [["a"] * 7])

def nothing():
    return None

def without_weights():
    raise FileNotFoundError(2, "No such file or directory", "weights.bin")

def misshapen():
    policy = Policy(zeros)
    policy.cameras = 5
    return policy

number = 5
"""


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(DEBUG_VARIABLE, raising=False)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    Path("ending_policy.py").write_text(POLICY)
    Path("ending_broken.py").write_text("def make(:\n")
    Path("ending_lacking.py").write_text("import a_package_that_is_not_there\n")
    return tmp_path


def test_a_fault_of_ours_is_a_traceback_and_a_request(monkeypatch, capsys):
    monkeypatch.setattr("libero_env.tasks.get_task", int)  # ValueError, of none of the user's code
    assert cli.main(["tasks", "show", "libero_goal/0"]) == ending.DEFECT
    found = capsys.readouterr().err
    assert found.startswith("Traceback") and "ValueError" in found
    assert "fault of libero-lifelong" in found and "libero doctor" in found


@pytest.mark.parametrize("number", [errno.EACCES, errno.ENOSPC, errno.EROFS, errno.EMFILE])
def test_what_the_system_refuses_is_one_line(number, monkeypatch, capsys):
    error = OSError(number, os.strerror(number), "some/file")
    assert ending.report(error) == ending.MISTAKE
    assert capsys.readouterr().err == f"error: some/file: {os.strerror(number)}\n"


def test_a_working_folder_that_was_removed_is_one_line(tmp_path, monkeypatch, capsys):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    here.rmdir()
    assert cli.main(["tasks", "list"]) == ending.MISTAKE
    assert capsys.readouterr().err == "error: the working folder was removed; change to one that exists\n"
    assert ending.report(ValueError("no folder")) == ending.DEFECT, "and errors are told there"


def test_the_exporters_errors_are_this_packages(monkeypatch, capsys):
    from libero_integrations.exports import results

    with pytest.raises(AttributeError) as caught:
        results.export_lerobot(None, Path())
    assert ending.report(caught.value) == ending.DEFECT
    assert "code of yours" not in capsys.readouterr().err


def test_a_write_that_fails_names_its_file(tmp_path):
    target = tmp_path / "kept.json"
    target.write_text("old")
    with pytest.raises(OSError, match=r"No space left.*kept\.json"), atomic_path(target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert [path.name for path in tmp_path.iterdir()] == ["kept.json"] and target.read_text() == "old"


def test_a_full_disk_is_one_line_for_videos_too(capsys):
    """PyAV is compiled, and its tracebacks name files that are not there; closing again raises nothing else."""
    pytest.importorskip("av")
    writer = Mp4Writer(Path("/dev/full"), 20)
    with pytest.raises(OSError, match="No space left") as caught, writer:
        writer.add(np.zeros((3, 16, 16, 3), np.uint8))
    writer.close()
    assert ending.report(caught.value) == ending.MISTAKE
    assert capsys.readouterr().err == f"error: /dev/full: {os.strerror(errno.ENOSPC)}\n"


def test_errors_by_kind(capsys):
    assert ending.report(MemoryError("Unable to allocate 7.45 TiB")) == ending.MISTAKE
    assert "not enough memory (Unable to allocate 7.45 TiB)" in capsys.readouterr().err
    assert ending.report(OSError("no number")) == ending.DEFECT
    assert ending.report(RecursionError("deep")) == ending.DEFECT
    capsys.readouterr()
    error = LiberoError("bad name '\x1b]0;title\x07\u202eabc'")  # of which a terminal obeys nothing
    assert ending.report(error, who="rank 1: ") == ending.MISTAKE
    assert capsys.readouterr().err == "error: rank 1: bad name '\\x1b]0;title\\x07\\u202eabc'\n"


@pytest.mark.parametrize(("policy", "message"), [
    ("ending_nowhere:make", "there is no module ending_nowhere, neither in the current folder ("),
    ("ending_policy.py:make", "a module is named without .py: write ending_policy:make, in the folder"),
    ("ending_policy:missing", "module ending_policy has no function missing"),
    ("ending_policy:number", "module ending_policy has a int, not a function, number"),
    ("ending_policy:nothing", "returns a NoneType without predict"),
    ("ending_policy:misshapen", "the policy's cameras is 5; expected a valid array"),
    ("ending_policy:without_weights", "ending_policy:without_weights() raised FileNotFoundError: [Errno 2]"),
    ("ending_broken:make", "the module ending_broken raised File"),
    ("ending_lacking:make", "the module ending_lacking raised ModuleNotFoundError: No module named 'a_package"),
    ("a b:c", "is not a name of a module"),
])  # fmt: skip
def test_a_policy_that_cannot_be_made_is_the_users(policy, message, here, capsys):
    assert cli.main(["eval", policy, "--suite", "libero_object/0"]) == ending.MISTAKE
    found = capsys.readouterr().err
    assert found.startswith("error: ") and message in found and "lifelong/" not in found, found


@pytest.mark.sim
def test_a_policy_that_raises_shows_its_own_frames(here, capsys):
    command = [
        "eval", "ending_policy:failing", "--suite", "libero_object/0", "--episodes", "1", "--horizon", "2"
    ]  # fmt: skip
    assert cli.main(command) == ending.MISTAKE
    found = capsys.readouterr().err
    assert "error: the policy's Policy.predict raised ValueError: no such weights\\x1b[2J\n" in found
    assert f'File "{here}/ending_policy.py", line 18, in fails\n    raise ValueError(' in found
    assert "lifelong/" not in found and "fault of libero-lifelong" not in found and "\x1b" not in found
    assert cli.main(["--debug", *command, "--again"]) == ending.MISTAKE
    assert "libero_eval/user_policy.py" in capsys.readouterr().err
    assert DEBUG_VARIABLE not in os.environ
    command[1] = "ending_policy:texts"
    assert cli.main(command) == ending.MISTAKE
    assert "the actions of Policy.predict: expected finite numbers of shape" in capsys.readouterr().err


@pytest.mark.sim
def test_a_module_that_is_imported_registers_predicates_for_every_command(tmp_path):
    """In a process of its own, as what is registered stays; workers know them, too."""
    (tmp_path / "my_predicates.py").write_text(
        "from libero_env import register_predicate\n"
        "register_predicate('afloat', lambda view, name, height: view.body_pos(name)[2] > float(height))\n"
    )
    (tmp_path / "near.yaml").write_text(
        "scene: kitchen\nobjects: [plate]\nplace: {plate_1: [0, 0]}\n"
        "goal: (And (Afloat plate_1 5) (Up plate_1))\nlanguage: lift the plate\n"
    )

    def run(*words):
        command = [sys.executable, "-m", "libero_cli", *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        return done.returncode, done.stdout + done.stderr

    status, said = run("tasks", "lint", "near.yaml", "--starts", "1")
    assert status == ending.MISTAKE and "near.yaml:4: (Afloat plate_1 5): Afloat is not a predicate" in said
    status, said = run("tasks", "lint", "near.yaml", "--starts", "1", "--import", "my_predicates")
    assert (status, said) == (0, "1 task: 0 errors, 0 warnings, 0 notes\n")
    words = ("tasks", "certify", "near.yaml", "--states", "2", "--jobs", "2")
    status, said = run("--import", "my_predicates", *words)
    assert "Afloat" not in said.replace("(Afloat plate_1 5)", ""), said
    assert "0/2 = 0.0 %" in said and status == 1, said
    for module, message in (
        ("my_predicatez", "there is no my_predicatez.py in "),
        ("x.py/", "expected a module"),
    ):
        status, said = run("tasks", "list", "--import", module)
        assert status == ending.MISTAKE and message in said and said.count("\n") == 1


def test_an_error_keeps_its_type_where_it_is_caught():
    with pytest.raises(ValueError, match="mine") as found, code_of("the policy"):
        raise ValueError("mine")
    assert found.value.__notes__ == ["raised by the policy"]
    with pytest.raises(LiberoError) as ours, code_of("the policy"):
        raise LiberoError("ours")
    assert not hasattr(ours.value, "__notes__")


@pytest.mark.parametrize(
    "words", [["--debug", "tasks", "show", "nope"], ["tasks", "show", "nope", "--debug"]]
)
def test_debug_shows_the_traceback_of_a_mistake(words, here, capsys):
    assert cli.main(words) == ending.MISTAKE
    found = capsys.readouterr().err
    assert found.startswith("Traceback") and "\nerror: unknown task 'nope'" in found


OWN_ALGORITHM = """
from lifelong import Algorithm

class Own(Algorithm):
    def __init__(self, *, strength: float):
        self.strength = strength / 0
"""


def test_an_algorithm_of_the_user_shows_its_own_frames(here, monkeypatch, capsys):
    Path("ending_algorithm.py").write_text(OWN_ALGORITHM)
    Path("algo").mkdir()
    Path("algo/own.yaml").write_text("_target_: ending_algorithm.Own\nstrength: 1.0\n")
    monkeypatch.setattr(sys, "argv", ["train.py"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.syspath_prepend(str(here))
    words = ["--config-dir", str(here), "preset=smoke", "algo=own", "tracker=none"]
    assert launch.main([*words, f"runs_dir={here}/runs"]) == ending.MISTAKE
    found = capsys.readouterr().err
    assert found.startswith("error: code of yours raised ZeroDivisionError: float division by zero\n")
    assert f'File "{here}/ending_algorithm.py", line 6, in __init__' in found and "lifelong/" not in found
    assert not Path("runs").exists()


def test_closed_streams_lead_nowhere(here):
    """Files that are opened would take their numbers; the status is that of the command, as in a cron job."""
    command = [sys.executable, "-m", "libero_cli"]
    right, wrong = (["protocols", "list"], 0), (["eval", "nowhere", "--out", "out"], 2)
    for closed, (words, status) in ((">&-", right), ("2>&-", wrong), ("<&- >&- 2>&-", wrong)):
        line, environment = f'exec "$@" {closed}', os.environ | {"PYTHONPATH": str(ROOT)}
        shell = ["sh", "-c", line, "sh", *command, *words]
        done = subprocess.run(shell, env=environment, capture_output=True)
        assert done.returncode == status, done
        assert b"Traceback" not in done.stdout + done.stderr
    assert not Path("out").exists()


@pytest.mark.parametrize("words", [  # of each kind; that every number has a range is tested in tests/fuzz
    ["eval", "m:f", "--seed", "-1"],
    ["eval", "m:f", "--timeout", "nan"],
    ["eval", "m:f", "--policy-threads", "1000000000"],
    ["eval", "m:f", "--episodes", "1.5"],
    ["eval", "m:f", "--out", " "],
    ["eval", "m:f", "--device", "zz"],
    ["power", "--tests", "1" + 400 * "0"],
    ["compare", "a", "b", "--alpha", "0"],
], ids=" ".join)  # fmt: skip
def test_numbers_out_of_range_are_named(words, capsys):
    with pytest.raises(SystemExit, match="2"):
        cli.main(words)
    found = capsys.readouterr().err
    option = [word for word in words if word.startswith("--")][-1]
    assert option in found and "Traceback" not in found


@pytest.mark.parametrize(("words", "message"), [
    (["tasks", "show", "a\0"], "null character"),
    (["tasks", "show", ""], "the word after show is empty"),
    (["eval", "ending_policy:make", "--suite", "libero_goal/0", "--after", "9"], "--after is of a run, and"),
    (["eval", "ending_policy:make", "--suite", "libero_goal/0", "--despite", "x"], "--despite is of results"),
    (["tasks", "preview", "libero_goal/3", "--out", "a.zzz"], "the name of a picture ends in .png"),
])  # fmt: skip
def test_names_that_are_none(words, message, here, capsys):
    assert cli.main(words) == ending.MISTAKE
    found = capsys.readouterr().err
    assert found.startswith("error: ") and message in found and found.count("\n") == 1
    assert not list(here.parent.glob("*.yaml"))


@pytest.mark.parametrize("address", [
    "ws://", "ws://host:99999", "ws://[::1", "ws://host:0x", "ws://a b:1", "vla-eval://", "gr00t://", "gr00t://host",
    "gr00t://host:5555/", "gr00t://me@host:5555"
])  # fmt: skip
def test_what_is_no_address_is_refused_at_once(address, here, capsys):
    assert cli.main(["eval", address, "--suite", "libero_goal/0"]) == ending.MISTAKE
    found = capsys.readouterr().err
    assert found.startswith(f"error: {address} is not an address; write ") and found.count("\n") == 1


@pytest.mark.sim
def test_warnings_of_mujoco_are_logged_once_and_make_no_file(here, caplog):
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    mujoco_compat.log_warnings()

    def break_down() -> None:
        data = mujoco.MjData(model)
        data.qvel[3] = np.nan
        mujoco.mj_step(model, data)

    mujoco_compat._warned.clear()
    break_down()
    thread = threading.Thread(target=break_down)
    thread.start()
    thread.join()
    assert [record.name for record in caplog.records] == ["libero_env.mujoco"]
    assert "Nan, Inf or huge value in QVEL at DOF 3" in caplog.text
    assert not (here / "MUJOCO_LOG.TXT").exists()


@pytest.mark.parametrize("name", ["libero", "openpi"])  # one horizon, and one for each suite
def test_the_memory_of_an_evaluation_is_estimated(name, tmp_path):
    task = get_task("libero_goal/0")
    plan = Evaluation({}, [task], (0, 1), load_protocol(name), tmp_path, None, None, videos=2, versions={})
    assert 6e8 < plan.memory(1) < 2e9 and plan.memory(3) == 3 * plan.memory(1)


def test_memory_is_looked_at_before_it_is_asked_for(monkeypatch):
    assert memory.host_memory()[0] > 10**6
    monkeypatch.setattr(memory, "host_memory", lambda: (10**9, 10**10))
    memory.require_memory(0.9e9, "this", "less of it")
    with pytest.raises(LiberoError, match=r"this needs about 2.0 GB of memory; 1.0 GB are free: less of it"):
        memory.require_memory(2e9, "this", "less of it")


@pytest.fixture
def heeded():
    """Signals are heeded as in a terminal: under nohup, or in the background of a script, some are ignored."""
    usual = {signal.SIGINT: signal.default_int_handler}
    usual |= dict.fromkeys((signal.SIGTERM, signal.SIGHUP), signal.SIG_DFL)
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_signals_interrupt_once_and_keep_what_is_ignored(heeded, monkeypatch):
    def handlers() -> list[object]:
        return [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]

    before = handlers()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        with pytest.raises(KeyboardInterrupt) as found, ending.interruptible():
            try:
                signal.raise_signal(number)
            finally:
                signal.raise_signal(number)  # at once, as `timeout` sends it: the same request
                with monkeypatch.context() as patch:
                    patch.setattr(ending.time, "monotonic", Mock(return_value=time.monotonic() + 2))
                    patch.setattr(ending.signal, "raise_signal", ended := Mock())
                    signal.getsignal(number)(number, None)
                assert ended.call_args.args == (number,) and signal.getsignal(number) is signal.SIG_DFL
        assert ending.report(found.value) == 128 + number
    assert handlers() == before
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ending.interruptible():
            signal.raise_signal(signal.SIGHUP)  # as under nohup
    finally:
        signal.signal(signal.SIGHUP, before[2])


def test_a_killed_worker_is_told():
    told = "a worker process ended.*The same command goes on"
    with pytest.raises(LiberoError, match=told), spawn_pool(1) as pool:
        pool.submit(os._exit, 1).result()


def started(words: list[str], folder: Path, ready: Callable[[int], bool]) -> subprocess.Popen:
    """A process of `libero`, as soon as it is ready, by its number."""
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "libero_cli", *words]
    process = subprocess.Popen(command, cwd=folder, env=env, stderr=subprocess.PIPE, text=True)
    assert within(lambda: ready(process.pid) or process.poll() is not None) and process.poll() is None
    return process


def within(true: Callable[[], bool]) -> bool:
    """Whether something is true soon."""
    end = time.monotonic() + PATIENCE
    while not true() and time.monotonic() < end:
        time.sleep(0.02)
    return true()


def descendants(pid: int) -> set[int]:
    """Numbers of the processes that a process has started."""
    children = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            children.setdefault(parent, set()).add(int(stat.parent.name))
        except (FileNotFoundError, ProcessLookupError):
            continue
    found, new = set(), {pid}
    while new:
        new = {child for parent in new for child in children.get(parent, ())}
        found |= new
    return found


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


EVALUATION = [
    "eval", "ending_policy:waiting", "--suite", "libero_object/0", "--unit-starts", "1", "--workers", "2"
]  # fmt: skip
RECORDING = ["demos", "generate", "--task", "libero_goal/7", "--n", "40", "--workers", "2"]
RECORDING += ["--folder", "kept", "--size", "16"]


@pytest.mark.sim
@pytest.mark.parametrize(
    ("words", "name", "kept"),
    [
        (EVALUATION, "SIGTERM", "eval/ending_policy.waiting keeps what is done"),
        (EVALUATION, "SIGKILL", ""),
        (RECORDING, "SIGHUP", "what is recorded is kept"),
        (RECORDING, "SIGKILL", ""),
    ],
)
def test_a_signal_ends_a_command_and_its_workers(words, name, kept, here, heeded):
    def ready(pid: int) -> bool:
        return (here / "started").exists() if words is EVALUATION else len(descendants(pid)) > 2

    process = started(words, here, ready)
    workers = descendants(process.pid)
    assert workers
    process.send_signal(number := getattr(signal, name))
    _, told = process.communicate(timeout=PATIENCE)
    assert within(lambda: not any(map(is_running, workers))), "no process is left"
    if kept:
        assert process.returncode == 128 + number
        assert f"interrupted by {name}; {kept}; the same command goes on" in told
        assert "Traceback" not in told and not list(here.rglob("claims/*"))


EVAL = ["eval", "expert", "--suite", "libero_object/0", "--episodes", "1", "--horizon", "2", "--out", "made"]
TRAIN = ["train", "preset=smoke", "device=cpu", "runs_dir=made"]


@pytest.mark.parametrize(
    ("words", "place"),
    [
        (EVAL, "libero_env.cli.options.parse"),
        (EVAL, "libero_eval.plan.plan_evaluation"),
        (TRAIN, "lifelong.jobs._launch"),
        (TRAIN, "lifelong.experiment._build_contexts"),
    ],
)
def test_an_interrupt_before_anything_is_begun_says_so(words, place, here, monkeypatch, heeded, capsys):
    monkeypatch.setattr(place, lambda *args: signal.raise_signal(signal.SIGINT))
    monkeypatch.setattr(sys, "argv", ["libero"])
    assert cli.main(words) == 130
    assert capsys.readouterr().err == "interrupted; nothing was begun\n" and not (here / "made").exists()
    monkeypatch.undo()
    monkeypatch.chdir(here)
    if words is EVAL:
        assert cli.main(["eval", "--status", "made"]) == 2
        assert capsys.readouterr().err == "error: made holds no evaluation: none was begun there\n"


@pytest.mark.parametrize("words", [EVAL, TRAIN, ["robustness", *EVAL[1:], "--kinds", "light"]])
def test_where_nothing_can_be_drawn_no_folder_is_made(words, here, monkeypatch, capsys):
    def broken():
        raise RenderError("no OpenGL backend works here")

    monkeypatch.setattr("libero_env.sim.render._opengl", broken)
    monkeypatch.setattr(sys, "argv", ["libero"])
    assert cli.main(words) == 2
    assert capsys.readouterr().err == "error: no OpenGL backend works here\n"
    assert not list((here / "made").rglob("*.json*"))


def test_a_unit_that_cannot_be_drawn_is_not_tried_again(here, monkeypatch, capsys):
    tried = []

    def broken(self, unit, *rest):
        tried.append(unit)
        raise RenderError("the window is gone")

    monkeypatch.setattr(Evaluation, "evaluate", broken)
    assert cli.main(EVAL) == 2
    assert len(tried) == 1 and capsys.readouterr().err.endswith("error: the window is gone\n")
