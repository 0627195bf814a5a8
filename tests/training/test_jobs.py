"""Exit codes and messages of a job and of a sweep, whichever process its jobs ran in."""

import errno
import io
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
from datetime import datetime, timedelta
from pathlib import Path

import forked
import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import OmegaConf

from mosa.cli.train import train
from mosa.errors import ConfigError
from mosa.reconstruction.cache import StageCache
from mosa.system import machine_errors
from mosa.system.npz import write_npz
from mosa.training import jobs
from mosa.training.jobs import (
    LONGEST,
    Failures,
    attempt,
    folder_name,
    held,
    options_first,
    quoted,
)

ROOT = Path(__file__).parents[2]


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """HydraConfig as job 3 of a sweep sees it, and the configuration that callbacks get."""
    config = OmegaConf.create({"sweep": {"dir": str(tmp_path)}, "job": {"num": 3}})
    config.mode = RunMode.MULTIRUN
    monkeypatch.setattr(HydraConfig, "get", staticmethod(lambda: config))
    return OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}})


def fail(error):
    def job(_):
        raise error

    return job


def test_a_sweep_counts_the_jobs_that_failed_in_this_sweep(sweep, tmp_path, capsys):
    counter = Failures()
    counter.on_multirun_start(sweep)
    assert attempt(lambda _: 0.5, None) == 0.5
    counter.on_multirun_end(sweep)
    assert Failures.count == 0
    assert attempt(fail(ConfigError("seed: wrong")), None) == float("inf")
    counter.on_multirun_end(sweep)
    assert (
        Failures.count == 1
        and "1 jobs of the sweep failed:\n  3: ConfigError: seed: wrong" in capsys.readouterr().err
    )
    counter.on_multirun_start(sweep)  # the same command again, in which the job succeeds
    counter.on_multirun_end(sweep)
    assert Failures.count == 0


def test_a_mistake_of_a_program_costs_a_sweep_its_job_alone(sweep, tmp_path, capsys):
    """A user's callback that raised ended the sweep, without its table and without failed/."""
    (tmp_path / "3_seed-3").mkdir()
    assert attempt(fail(ValueError("digits: x")), None) == float("inf")
    assert "Traceback" in capsys.readouterr().err
    Failures().on_multirun_end(sweep)
    assert "3: ValueError: digits: x" in capsys.readouterr().err
    assert Failures.count == 1 and "failed,ValueError: digits: x" in (tmp_path / "sweep.csv").read_text()  # fmt: skip


def test_a_mistake_of_the_program_is_not_swallowed(sweep):
    HydraConfig.get().mode = RunMode.RUN
    with pytest.raises(ZeroDivisionError):
        attempt(lambda _: 1 / 0, None)
    with pytest.raises(ConnectionResetError):
        attempt(fail(ConnectionResetError(errno.ECONNRESET, "reset")), None)


def test_a_run_folder_is_one_process_own_until_that_ends(tmp_path):
    """Two runs in one folder mixed their checkpoints and figures without a word."""
    code = (
        f"import time; from mosa.training.jobs import held\nwith held({str(tmp_path)!r}):\n    print('held', flush=True)\n"
        "    time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT
    ) as other:
        assert other.stdout.readline() == "held\n"
        with (
            pytest.raises(ConfigError, match=r"hydra\.run\.dir: another process is at work in"),
            held(tmp_path),
        ):
            pass
        other.kill()
        other.wait()
        with held(tmp_path):
            pass
    assert not list(tmp_path.iterdir())


def test_a_run_that_is_to_go_on_waits_for_the_process_that_is_at_work_in_its_folder(
    tmp_path, caplog
):
    """A worker that outlived its killed sweep made the job of the sweep that was given again fail."""
    code = (
        f"import sys; from mosa.training.jobs import held\nwith held({str(tmp_path)!r}):\n    print('held', flush=True)\n"
        "    sys.stdin.read()\n    print('ended', flush=True)"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], **pipes, text=True, cwd=ROOT) as other:
        assert other.stdout.readline() == "held\n"
        timer = threading.Timer(0.3, other.stdin.close)
        timer.start()
        with caplog.at_level("INFO"), held(tmp_path, wait=True):
            assert other.stdout.readline() == "ended\n"
        assert "another process is at work in" in caplog.text


def test_runs_that_begin_in_the_same_second_have_a_folder_each():
    """Of two commands given in one line the second was refused: another process was at work in its folder."""
    folder = (
        (ROOT / "conf" / "hydra" / "default.yaml").read_text().split("${now:", 2)[2].split("}")[0]
    )
    began = datetime(2026, 1, 2, 3, 4, 5, 6)
    assert began.strftime(folder) != (began + timedelta(milliseconds=1)).strftime(folder)


def test_a_folder_that_was_removed_meanwhile_is_one_message(sweep, tmp_path, capsys):
    attempt(lambda _: write_npz(tmp_path / "gone" / "observed.npz", {}), None)
    assert (
        "observed.npz" in (said := capsys.readouterr().err)
        and "its folder has been removed meanwhile" in said
    )
    attempt(lambda _: StageCache(Path("/proc/nowhere"), {"scene": "a"}), None)
    assert "/proc/nowhere: cannot be written" in (said := capsys.readouterr().err)
    assert "choose other folders with hydra.run.dir=" in said and "scene.cache=" in said
    HydraConfig.get().mode = RunMode.RUN
    with pytest.raises(FileNotFoundError):  # a file that is not there is the program's
        attempt(lambda _: (tmp_path / "none").read_text(), None)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EFBIG])
def test_what_a_disk_refuses_is_one_message(sweep, capsys, code):
    attempt(fail(OSError(code, os.strerror(code), "/full/file")), None)
    assert f"/full/file: cannot be written or read ({os.strerror(code)})" in capsys.readouterr().err


def test_a_single_run_exits_with_2(sweep, monkeypatch):
    HydraConfig.get().mode = RunMode.RUN
    with pytest.raises(SystemExit) as caught:
        attempt(fail(ConfigError("seed: wrong")), None)
    assert caught.value.code == 2


@pytest.mark.parametrize("error", [
    MemoryError(), RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes."),
    RuntimeError("CUDA out of memory. Tried to allocate 9.00 GiB"), OSError(errno.EMFILE, os.strerror(errno.EMFILE), "/a/file"),
])  # fmt: skip
def test_what_the_machine_has_not_is_one_message(sweep, capsys, error):
    attempt(fail(error), None)
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and ("simulation.particles" in said or "ulimit -n" in said)
    HydraConfig.get().mode = RunMode.RUN
    with pytest.raises(RuntimeError):
        attempt(fail(RuntimeError("another one")), None)


def test_an_error_of_a_gpus_libraries_counts_as_memory_where_the_gpu_is_full_alone(
    sweep, capsys, monkeypatch
):
    """Warp raises a plain Exception for a module that finds no room, cuBLAS says that it is not initialised."""
    for error in (
        Exception("Failed to load CUDA module 'p2g'"),
        RuntimeError("CUDA error: CUBLAS_STATUS_NOT_INITIALIZED"),
    ):
        monkeypatch.setattr(machine_errors, "gpu_memory", lambda: (0.2e9, 150e9))
        HydraConfig.get().mode = RunMode.MULTIRUN
        attempt(fail(error), None)
        assert "the GPU has no memory left" in capsys.readouterr().err
        HydraConfig.get().mode = RunMode.RUN
        for room in (None, (60e9, 150e9)):
            monkeypatch.setattr(machine_errors, "gpu_memory", lambda r=room: r)
            with pytest.raises(type(error)):
                attempt(fail(error), None)
    monkeypatch.setattr(machine_errors, "gpu_memory", lambda: (0.2e9, 150e9))
    with pytest.raises(
        ZeroDivisionError
    ):  # a mistake of the program stays one, full as the GPU may be
        attempt(lambda _: 1 / 0, None)


def test_a_warning_that_was_made_an_error_is_one_message(sweep, capsys):
    """PYTHONWARNINGS=error, as continuous integrations set it: Python raises it wherever it arises."""
    attempt(fail(UserWarning("simulation.particles: thin parts")), None)
    said = capsys.readouterr().err.strip()
    assert (
        said.startswith("UserWarning: simulation.particles: thin parts")
        and "PYTHONWARNINGS" in said
    )


def test_a_message_about_memory_names_the_checkpoint_that_is_kept(tmp_path):
    assert machine_errors.explained(MemoryError(), tmp_path) == machine_errors.explained(
        MemoryError()
    )
    (tmp_path / machine_errors.LAST).parent.mkdir()
    (tmp_path / machine_errors.LAST).write_text("")
    assert f"the fit is kept in {tmp_path / machine_errors.LAST}" in machine_errors.explained(
        MemoryError(), tmp_path
    )
    assert machine_errors.explained(ValueError("x"), tmp_path) is None
    assert "simulation.particles" in machine_errors.explained(
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))
    )


def test_a_long_name_is_cut_and_stays_its_own():
    assert folder_name("a=1,b=[2,x]") == "a-1_b-_2_x_"
    for name in ("prior.parameters.E=1e-3,seed=0", "scene.test=[a, b]", "x=ü{}'"):
        given = f"ckpt_path=multirun/0_{folder_name(name)}/last.ckpt"
        assert quoted(given) == given or "ü" in name
    assert "/" not in folder_name("splats=../../x.ply")
    names = {folder_name("x" * 500 + str(i)) for i in range(50)}
    assert len(names) == 50 and all(len(name.encode()) <= LONGEST + 9 for name in names)
    assert len(folder_name("ü" * 500).encode()) <= LONGEST + 9


@pytest.mark.parametrize(("argument", "found"), [
    ("scene.path=/data/höhle", "scene.path='/data/höhle'"), ("scene.path=~/x", "scene.path='~/x'"),
    ("scene.path=/a=b & c", "scene.path='/a=b & c'"), ("scene.path=/a b", "scene.path=/a b"), ("seed=0,1", "seed=0,1"),
    ("fit.x=[ä]", "fit.x=[ä]"), ("x='ä'", "x='ä'"), ("prior=ä,b", "prior=ä,b"), ("--cfg=ä", "--cfg=ä"), ("banana", "banana"),
    ("scene.path=/a's b", r"scene.path='/a\'s b'"), ("scene.path=/a b, [c] {d}", "scene.path='/a b, [c] {d}'"),
    ("x=/a,/b", "x=/a,/b"),
])  # fmt: skip
def test_values_that_hydra_cannot_read_are_quoted(argument, found):
    """It ended a run whose path had an umlaut in it."""
    assert quoted(argument) == found
    if argument.startswith("scene.path="):
        (read,) = OverridesParser.create().parse_overrides([found])
        assert str(read.value()) == argument.partition("=")[2]


def test_overrides_may_stand_before_an_option_and_after_it():
    words = [
        "debug=default",
        "--config-dir",
        "a=b/conf",
        "experiment=team",
        "-m",
        "~logger",
        "--info",
    ]
    assert options_first(["", "seed=1", "--cfg", "job"]) == ["--cfg", "job", "", "seed=1"]
    assert options_first(words) == [
        "--config-dir",
        "a=b/conf",
        "-m",
        "--info",
        "debug=default",
        "experiment=team",
        "~logger",
    ]


@pytest.fixture
def refused_command(monkeypatch, capsys):
    """Runs train.py's command, which is refused; its message."""

    def run(*words: str) -> str:
        monkeypatch.setattr(jobs, "begun", [])
        monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
        monkeypatch.setattr(sys, "argv", ["train.py", *words])
        with pytest.raises(SystemExit) as ended:
            train()
        said = capsys.readouterr().err
        assert ended.value.code == 2 and "Traceback" not in said and len(said) < 3000
        return said

    return run


@pytest.mark.parametrize(("words", "message"), [
    (["criterion=5"], r"override must be a string or a list. Got int\n\(in: criterion=5\)"),
    (["seed=" + "9" * 5000], r"Exceeds the limit .* for integer string conversion"),
    (["banana"], "Error parsing override 'banana'"), (["banana=3"], r"override 'banana'\.\nKey 'banana' is not in"),
    (["scene=banana"], "scene: expected one of .*, found banana"), (["-m", "prior=foo,stvk"], "prior: expected .*, found foo"),
    (["hydra.run.dir="], r"hydra\.run\.dir: expected a folder, found nothing"),
    (["hydra.run.dir=file/below"], r"file/below: cannot be written or read \(Not a directory\)"),
    (["-m", "seed=0,1", "hydra.sweep.dir=file/below"], r"file/below: cannot be written or read \(Not a directory\)"),
    (["-m", "seed=0,1", "hydra.sweep.subdir=here"], r"hydra\.sweep\.subdir: expected a name that is another one"),
])  # fmt: skip
def test_what_is_wrong_before_a_job_begins_is_one_message(
    tmp_path, monkeypatch, refused_command, words, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert re.search(message, refused_command(*words))


@pytest.mark.parametrize(("text", "message"), [
    (b"simulation:\n\tparticles: 200\n", r'cannot start any token\n +in ".*experiment/mine\.yaml", line 2'),
    (b"seed: 1\nseed: 2\n", r"found duplicate key"), ("scene:\n  path: /h\u00f6hle\n".encode("latin-1"), "invalid start byte"),
])  # fmt: skip
def test_yaml_that_cannot_be_read_is_one_message(tmp_path, refused_command, text, message):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_bytes(text)
    assert re.search(message, refused_command(f"--config-dir={tmp_path}", "experiment=mine"))


def test_a_stop_of_a_sweep_names_the_sweep(sweep, tmp_path, monkeypatch):
    """With the checkpoint of one job as ckpt_path every job would have begun from it."""
    config, said = HydraConfig.get(), []
    config.runtime = {"output_dir": str(tmp_path / "3")}
    (tmp_path / "3" / "checkpoints").mkdir(parents=True)
    (tmp_path / "3" / "checkpoints" / "last.ckpt").touch()
    monkeypatch.setattr(HydraConfig, "initialized", staticmethod(lambda: True))
    monkeypatch.setattr(jobs, "leave", lambda *message: said.append(message[0]) or sys.exit(130))
    with pytest.raises(SystemExit):
        attempt(fail(KeyboardInterrupt()), None)
    assert said == [f"stopped; resume with resume=auto hydra.sweep.dir={tmp_path}"]


PROGRAM = """
    import os, signal, sys
    from mosa.training.jobs import attempt
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell that put pytest into the background had it ignored
    def job(cfg):
        os.kill(os.getpid(), signal.SIG{name})
    attempt(job, None)
"""


@pytest.mark.parametrize(("name", "code"), [("TERM", 143), ("INT", 130)])
def test_a_stop_says_how_to_go_on(name, code, tmp_path):
    """Where a checkpoint is there: before the fit there is none."""
    if name == "TERM":
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / "last.ckpt").touch()
    found = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(PROGRAM.format(name=name))],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (
        found.returncode == code
        and "stopped" in found.stderr
        and ("resume with ckpt_path=checkpoints/last.ckpt" in found.stderr) == (name == "TERM")
        and "Traceback" not in found.stderr
    )


@pytest.mark.parametrize("name", ["TERM", "INT"])
def test_a_second_stop_on_the_way_out_is_no_traceback(name):
    """It fell into a library's clearing up at the interpreter's exit."""
    leaving = f"import atexit, os, signal; atexit.register(lambda: os.kill(os.getpid(), signal.SIG{name}))\n"
    found = subprocess.run([sys.executable, "-c", leaving + textwrap.dedent(PROGRAM.format(name=name))], cwd=ROOT,
                           capture_output=True, text=True, timeout=60)  # fmt: skip
    assert found.returncode == -getattr(signal, f"SIG{name}")
    assert "stopped" in found.stderr and "Traceback" not in found.stderr


def test_a_joblib_sweep_with_failed_jobs_does_not_exit_with_0(tmp_path):
    """train.py's command but for the job itself, whose imports take a worker ten seconds."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    (tmp_path / "failing.py").write_text(
        "from mosa.errors import ConfigError\n\n\ndef job(cfg):\n    raise ConfigError(f'seed: {cfg.seed}')\n"
    )
    program = """
        from mosa.cli import train
        from mosa.cli.configured import command
        train.train = command("mosa.cli.train", "failing:job")
        train.main()
    """
    (tmp_path / "program.py").write_text(textwrap.dedent(program))
    keys = [
        "hydra/launcher=joblib",
        "hydra.launcher.n_jobs=2",
        f"hydra.sweep.dir={tmp_path}/sweep",
        "seed=1,2",
    ]
    places = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    found = subprocess.run([sys.executable, tmp_path / "program.py", "-m", *keys], cwd=ROOT, capture_output=True, text=True,
                           timeout=300, env=places)  # fmt: skip
    assert found.returncode == 1 and "2 jobs of the sweep failed" in found.stderr
    assert "0: ConfigError: seed: 1" in found.stderr and "1: ConfigError: seed: 2" in found.stderr


OUTLIVED = """
    import logging, sys
    from mosa.system.console import begin_log
    from mosa.system.screen import tolerant_output
    with tolerant_output():
        logging.basicConfig(stream=sys.stdout, level=logging.INFO)
        begin_log()
        for k in range(2000):
            logging.info("a line %d", k)
            print("another", file=sys.stderr)
        open({done!r}, "w").close()
"""


@pytest.mark.parametrize(
    "shell", ["{} 2>&1 | head -1", "{} | head -1", "{} >&- 2>&-", "{} > /dev/full 2>&1"]
)
def test_a_run_outlives_whoever_reads_its_lines(tmp_path, shell):
    """`| head -1` ended a run without a word, and printed hundreds of tracebacks where the reader of the output alone had gone."""
    done = tmp_path / "done"
    program = f"{sys.executable} -c {shlex.quote(textwrap.dedent(OUTLIVED.format(done=str(done))))}"
    found = subprocess.run(
        ["bash", "-o", "pipefail", "-c", shell.format(program)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0 and done.is_file() and "Error" not in found.stderr
    assert found.stdout.count("\n") <= 1


def test_a_working_folder_that_is_gone_is_said(tmp_path):
    (tmp_path / "gone").mkdir()
    command = f"cd {tmp_path}/gone && rmdir ../gone && exec {sys.executable} {ROOT}/train.py debug=default"
    found = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=60, cwd=ROOT,
                           env={**os.environ, "PYTHONPATH": str(ROOT)})  # fmt: skip
    assert (
        found.returncode == 2 and "the folder that this was started in is no more" in found.stderr
    )
    assert "Traceback" not in found.stderr


def test_a_stop_before_the_first_job_is_no_traceback():
    code = textwrap.dedent("""
        from mosa.training.jobs import run_command; import os, signal, sys
        sys.argv[1:] = []
        signal.signal(signal.SIGINT, signal.default_int_handler)
        run_command(lambda: os.kill(os.getpid(), signal.SIGINT))
    """)
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert found.returncode == 130 and found.stderr.strip() == "stopped"


@pytest.mark.parametrize(("times", "imported"), [(1, True), (2, False)])
@pytest.mark.parametrize(("name", "code"), [("TERM", 143), ("INT", 130)])
def test_a_stop_waits_for_the_imports_and_a_second_one_does_not(
    tmp_path, name, code, times, imported
):
    """Ctrl-C in the middle of an extension's import aborted the interpreter, with a traceback."""
    (tmp_path / "slow_module.py").write_text(f"""
import os, signal
for _ in range({times}):
    os.kill(os.getpid(), signal.SIG{name})
print("imported", flush=True)
""")
    program = """
        import signal, sys
        from mosa.training.jobs import attempt, held_back
        signal.signal(signal.SIGINT, signal.default_int_handler)
        def job(cfg):
            with held_back():
                import slow_module
            print("ran")
        attempt(job, None)
    """
    found = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], cwd=tmp_path, capture_output=True, text=True,
                           timeout=60, env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"})  # fmt: skip
    assert (
        found.returncode == code and "Traceback" not in found.stderr and "stopped" in found.stderr
    )
    assert found.stdout == ("imported\n" if imported else "")


def test_a_message_is_kept_where_nobody_reads_the_screen(sweep, tmp_path, monkeypatch):
    """A worker of a launcher whose screen had gone ended in a broken pipe, and the sweep did not say why its job had failed."""

    class Gone(io.StringIO):
        def write(self, text):
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

        def fileno(self):
            return nowhere

    nowhere = os.open(os.devnull, os.O_WRONLY)
    monkeypatch.setattr(sys, "stderr", Gone())
    assert attempt(fail(ConfigError("seed: wrong")), None) == float("inf")
    os.close(nowhere)
    assert (tmp_path / "failed" / "3.txt").read_text() == "ConfigError: seed: wrong\n"


LAUNCHED = """
    import sys
    import warp as wp
    from mosa.system import machine_errors
    wp.config.kernel_cache_dir = sys.argv[1]

    @wp.kernel
    def twice(x: wp.array(dtype=float)):
        x[wp.tid()] = 2.0 * x[wp.tid()]

    try:
        wp.launch(twice, 1, inputs=[wp.ones(1, dtype=float, device="cpu")], device="cpu")
    except Exception as error:
        print(machine_errors.explained(error))
    else:
        print("ran")
"""


@pytest.fixture(scope="module")
def launched(tmp_path_factory):
    """Launches a kernel of a folder of compiled ones in a process of its own, as a loaded kernel stays so; what it says."""
    folder = tmp_path_factory.mktemp("launched")
    (folder / "kernel.py").write_text(textwrap.dedent(LAUNCHED))

    def launch(kernels: Path) -> str:
        return forked.call(str(folder / "kernel.py"), str(kernels)).stdout.strip().splitlines()[-1]

    assert launch(folder / "kernels") == launch(folder / "kernels") == "ran"
    return folder / "kernels", launch


@pytest.mark.parametrize(("ending", "damage"), [
    (".o", lambda file: file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])),
    (".o", lambda file: file.write_bytes(b"")),
    (".o", lambda file: file.write_bytes(bytes(file.stat().st_size))), (".meta", lambda file: file.write_bytes(b"")),
])  # fmt: skip
def test_damaged_kernels_are_one_message(tmp_path, launched, ending, damage):
    """As a killed compiler or a full disk leave them."""
    compiled, launch = launched
    kernels = Path(shutil.copytree(compiled, tmp_path / "kernels"))
    files = [file for file in kernels.rglob("*") if file.suffix == ending]
    for file in files:
        damage(file)
    found = launch(kernels)
    assert files and str(kernels) in found
    assert "expected kernels as they were compiled, found some that cannot be loaded" in found


def test_what_a_compiler_refuses_is_no_damaged_kernel():
    """A mistake of the program keeps its traceback."""
    assert (
        machine_errors.explained(RuntimeError("Failed to load CPU module 'm'")) is None
    )  # not from where Warp loads
