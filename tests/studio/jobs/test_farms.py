"""Recipes for farms: scripts for Slurm with stubs of its commands; the template of Open Job Description, really run."""

import os
import pathlib
import shutil
import signal
import subprocess
import sys
import textwrap
import time

import pytest
from runs import DEFORMED, SMALL, require_same_film, succeed, write_files

RECIPES = pathlib.Path(__file__).resolve().parents[3] / "examples" / "clusters"

#: Notes how each command was called.
NOTING = '#!/bin/bash\necho "$(basename "$0") $*" >> "$LOG"\n'

#: `srun` as Slurm has it: here the command is run on this machine.
SRUN = NOTING + 'while [[ "$1" == --* ]]; do shift; done\nexec "$@"\n'

#: Ray stays in the foreground.
RAY = NOTING + "[ ${#RAY_AUTH_TOKEN} = 64 ] && exec sleep 60\n"


@pytest.fixture
def farm(tmp_path):
    """A folder of commands, and the environment in which they are found first."""
    bin_folder = tmp_path / "bin"
    bin_folder.mkdir()
    environment = dict(os.environ, PATH=f"{bin_folder}:{os.environ['PATH']}", LOG=str(tmp_path / "log"))
    environment |= {"SLURM_JOB_ID": "30017", "SLURM_JOB_NODELIST": "node[1-3]", "RAY_HEAD_SECONDS": "0"}

    def command(name, text):
        (bin_folder / name).write_text(text)
        (bin_folder / name).chmod(0o755)

    command("scontrol", NOTING + '[ "$1" = show ] && printf "node1\\nnode2\\nnode3\\n" || true\n')
    command("srun", SRUN)
    command("ray", RAY)
    # waits for all nodes, as the script's own does
    command("python", NOTING + 'cat > /dev/null\nuntil [ "$(grep -c "^ray start" "$LOG")" -ge "$(($2 > 1 ? 2 : 1))" ]\n'
            + "do sleep 0.01; done\n")  # fmt: skip
    command("hostname", NOTING + 'echo "10.0.0.7 192.168.0.7 "\n')
    return command, environment, tmp_path / "log"


def sbatch(script, *argv, environment):
    return subprocess.Popen([RECIPES / script, *argv], env=environment, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("script", ["ray.sbatch", "array.sbatch"])
def test_scripts_are_bash_and_say_how_they_are_called(script):
    subprocess.run(["bash", "-n", RECIPES / script], check=True)
    assert os.access(RECIPES / script, os.X_OK)
    assert f"examples/clusters/{script} film.jsonl /shared/frames" in (RECIPES / script).read_text()


@pytest.mark.parametrize(("nodes", "status"), [(3, 0), (1, 1)])
def test_ray_over_the_nodes_of_an_allocation(farm, nodes, status):
    command, environment, log = farm
    command("warpcage", NOTING + f"exit {status}\n")
    environment["SLURM_JOB_NUM_NODES"] = str(nodes)
    done = sbatch("ray.sbatch", "film.jsonl", "out", "--retries", "3", environment=environment)
    assert done.wait(60) == status, done.stderr.read()
    calls = log.read_text().splitlines()
    heads = [call for call in calls if call.startswith("ray start --head")]
    assert heads == ["ray start --head --node-ip-address=10.0.0.7 --port=30017 --include-dashboard=false --block"]
    others = [call for call in calls if call.startswith("ray start --address")]
    assert others == ["ray start --address=10.0.0.7:30017 --block"][: nodes - 1]
    steps = [call for call in calls if call.startswith("srun") and "--address" in call]
    assert all(f"--nodes={nodes - 1} --ntasks={nodes - 1} --exclude=node1" in step for step in steps)
    assert calls[-1] == "warpcage run film.jsonl -o out --cluster 10.0.0.7:30017 --quiet --retries 3"
    assert f"python - {nodes}" in calls


def test_a_job_whose_time_is_over_ends_cleanly_and_is_queued_again(farm):
    command, environment, log = farm
    # as warpcage ends after SIGTERM: it cleans up, and says so by its status
    body = "trap 'kill $!; echo cleaned >> \"$LOG\"; exit 143' TERM\nsleep 60 &\n" + NOTING + "wait\n"
    command("warpcage", "#!/bin/bash\n" + body)
    environment["SLURM_JOB_NUM_NODES"] = "1"
    job = sbatch("ray.sbatch", "film.jsonl", "out", environment=environment)
    end = time.monotonic() + 60
    while not log.exists() or "warpcage run" not in log.read_text():
        assert time.monotonic() < end and job.poll() is None
        time.sleep(0.02)
    job.send_signal(signal.SIGTERM)  # to the shell alone, as --signal=B: has it
    assert job.wait(60) == 143
    assert log.read_text().splitlines()[-2:] == ["cleaned", "scontrol requeue 30017"]


def test_a_task_of_an_array_makes_its_part(farm):
    command, environment, log = farm
    command("warpcage", NOTING)
    environment["SLURM_ARRAY_TASK_ID"] = "7"
    assert sbatch("array.sbatch", "a film.jsonl", "out", "16", environment=environment).wait(60) == 0
    assert log.read_text() == "warpcage run a film.jsonl -o out --part 7/16 --quiet\n"


def test_a_job_file_of_no_film_is_reported_in_one_line(tmp_path):
    """The program that the last step of the template holds, run on a job file alone."""
    lines = (RECIPES / "frames.openjd.yaml").read_text().split("          data: |\n")[1]
    (tmp_path / "encode.py").write_text(textwrap.dedent(lines))
    (tmp_path / "jobs.jsonl").write_text(
        '{"format": "warpcage jobs", "version": 1}\n{"id": "rest", "field": "ball.npz", "camera": "cameras.json#0"}\n'
    )
    argv = [sys.executable, "encode.py", "jobs.jsonl", "frames", "film.mp4"]
    done = subprocess.run(argv, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("jobs.jsonl is of no film, as `warpcage animate --jobs` writes it")


@pytest.mark.nightly
def test_the_template_of_a_render_farm_makes_the_film_of_animate(farm, tmp_path):
    openjd = shutil.which("openjd", path=f"{pathlib.Path(sys.executable).parent}:{os.environ['PATH']}")
    if openjd is None:
        pytest.skip("openjd-cli is not installed")
    command, environment, log = farm
    command("warpcage", NOTING + f'exec {sys.executable} -m warpcage "$@"\n')
    command("python", f'#!/bin/bash\nexec {sys.executable} "$@"\n')
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    (tmp_path / "files").mkdir()
    files = write_files(tmp_path / "files")
    film = (
        *"animate @ball.npz".split(),
        *DEFORMED,
        *SMALL,
        *"--size 64 --frames 4 --fps 12 --quiet --device cpu".split(),
    )
    succeed(files, *film, "-o", tmp_path / "one.mp4")
    succeed(files, *film, "--jobs", files / "film.jsonl")
    values = {"JobFile": files / "film.jsonl", "Output": tmp_path / "frames", "Parts": 2, "Device": "cpu"}
    values["Film"] = tmp_path / "film.mp4"
    argv = [word for name, value in values.items() for word in ("-p", f"{name}={value}")]
    run = [openjd, "run", RECIPES / "frames.openjd.yaml", "--step", "Film", "--run-dependencies", *argv]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    parts = [call.split("--part ")[1].split()[0] for call in log.read_text().splitlines() if "--part" in call]
    assert parts == ["1/2", "2/2"]
    assert len((tmp_path / "frames" / "manifest.jsonl").read_text().splitlines()) == 4
    require_same_film(tmp_path / "film.mp4", tmp_path / "one.mp4")
