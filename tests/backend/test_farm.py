"""The job templates of examples/farm/: their command lines are those of the backend, in the right order."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from backend.cli.parser import build_parser
from backend.shared.formats.json_file import write_json
from backend.shared.reconstruction.cameras import Cameras, CameraView, write_cameras

FARM = Path(__file__).resolve().parents[2] / "examples" / "farm"
EXIT_CODE = ["--python-exit-code", "1"]
"""Without it, Blender ends with exit code 0 if it does not find headless.py."""
EACH_CAPTURE = ["train", "mesh", "evaluate", "report"]

COMPILE = """
const fs = require("fs");
const tasks = [];
const author = {
    Task: (name, type) => ({ name, type, commands: [], needs: [],
        addCommand(command) { this.commands.push(command); },
        addDependency(task) { this.needs.push(task.name); } }),
    Command: (name, parameters) => ({ name, parameters }),
};
const frameChunker = (frames, size) => frames.split(",");
const script = fs.readFileSync(process.argv[1], "utf8") + "; return [compileJob, JOB_TYPE];";
const [compile, type] = new Function("author", "frameChunker", script)(author, frameChunker);
const settings = JSON.parse(process.argv[2]);
for (const setting of type.settings) {
    if (!(setting.key in settings) && "default" in setting) settings[setting.key] = setting.default;
    if (setting.required && !(setting.key in settings)) throw new Error(setting.key);
}
compile({ settings, addTask(task) { tasks.push(task); } });
console.log(JSON.stringify(tasks));
"""


def compiled(name, **settings):
    """Return the tasks that Flamenco's manager would make of a job type."""
    if shutil.which("node") is None:
        pytest.skip("compiling job types of Flamenco needs node")
    words = ["node", "-e", COMPILE, str(FARM / name), json.dumps(settings)]
    return json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)


def parsed(arguments):
    """Return the options of the command line after the code that starts the backend and its folder."""
    assert arguments[0] == "-c"
    return build_parser().parse_args(arguments[3:])


def start_of(name):
    """Return the code that starts the backend in a job type of Flamenco."""
    script = (FARM / name).read_text()
    begin = script.index("const START")
    return "".join(re.findall(r'"([^"]*)"', script[begin : script.index(";\n", begin)]))


def write_views(folder, *, held_out):
    """Write cameras.json as `train` does."""
    folder.mkdir(parents=True, exist_ok=True)
    views = [
        CameraView(f"{i}.png", folder / f"{i}.png", None, 8, 8, np.eye(3), np.eye(4), is_held_out)
        for i, is_held_out in enumerate((held_out, False))
    ]
    write_cameras(folder, Cameras(folder, np.zeros(3), np.eye(4), views))


MESH_ENDS = [
    ({"meshes": {"1": {"why": "No surface."}}}, "0", 0),
    ({"meshes": {"1": {"why": "No surface."}}}, "2", 0),
    ({"meshes": {"1": {"why": "No surface."}}}, "1", 1),
    ({"meshes": {}, "waiting": ["1"]}, "2", 2),
    (None, "2", 2),
]
"""Content of meshes.json, exit code of `mesh`, and exit code with which a job ends before the evaluation."""


def write_meshes_json(folder, content):
    """Write meshes.json as `mesh` does, or delete it."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    path = folder / "meshes" / "meshes.json"
    path.unlink(missing_ok=True)
    if content is not None:
        write_json(path, content)


def write_captures(folder):
    """Write two captures, of which the second holds out a view, and another folder; return `folder`."""
    write_views(folder / "a $b", held_out=False)
    write_views(folder / "b's", held_out=True)
    for own in ("a $b/sparse", "b's/images", "0"):
        (folder / own).mkdir()
    return folder


def commands_of(lines):
    """Return the commands of command lines of the backend, after checking that they concern one reconstruction."""
    options = [build_parser().parse_args(words) for words in lines]
    assert len({o.out if o.command == "train" else o.folder for o in options}) == 1
    return [o.command for o in options]


def test_flamenco_trains_cells_between_split_and_merge():
    tasks = compiled("flamenco-cells.js", capture="/c", out="/o", cells=3, cell_minutes=7.5)
    assert [task["name"] for task in tasks] == ["train", "split", "cell-0", "cell-1", "cell-2", "merge"]
    needs = {task["name"]: task["needs"] for task in tasks}
    assert needs["split"] == ["train"] and needs["cell-1"] == ["split"]
    assert needs["merge"] == ["cell-0", "cell-1", "cell-2"]
    assert all(command["name"] == "exec" for task in tasks for command in task["commands"])
    options = [parsed(task["commands"][0]["parameters"]["args"]) for task in tasks]
    assert [o.command for o in options] == ["train", "split", *["train-cell"] * 3, "merge"]
    assert options[1].cells == 3 and [o.cell for o in options[2:5]] == [0, 1, 2] and options[3].minutes == 7.5


def test_flamenco_renders_a_film_by_ranges():
    tasks = compiled("flamenco-film.js", blend="/s.blend", out="/f", frames="1-24,50-80", objectgs="/x")
    arguments = [task["commands"][0]["parameters"]["args"] for task in tasks]
    assert [words[words.index("--frames") + 1] for words in arguments] == ["1-24", "50-80"]
    assert all(
        words[:4] == ["-b", *EXIT_CODE, "-P"] and words[6] == "film" and "--dir" not in words for words in arguments
    )
    moved = compiled("flamenco-film.js", blend="/s.blend", out="/f", frames="1", objectgs="/x", dir="/a b")
    assert moved[0]["commands"][0]["parameters"]["args"][-2:] == ["--dir", "/a b"]


def test_flamenco_measures_each_capture_in_a_task(tmp_path):
    settings = {"captures": "/my captures", "out": str(tmp_path / "out"), "minutes": 7.5, "objectgs": str(tmp_path)}
    tasks = compiled("flamenco-captures.js", names="garden, bob's mug,\nkitchen,", **settings)
    assert [task["name"] for task in tasks] == ["garden", "bob's mug", "kitchen"]
    assert not any(task["needs"] for task in tasks)
    assert all(command["name"] == "exec" for task in tasks for command in task["commands"])
    lines = [[command["parameters"]["args"] for command in task["commands"]] for task in tasks]
    assert all(commands_of([words[3:] for words in line]) == EACH_CAPTURE for line in lines)
    train, mesh, evaluate, _ = lines[1]
    options = parsed(train)
    assert (options.capture, options.minutes) == (Path("/my captures/bob's mug"), 7.5)
    assert options.out == tmp_path / "out" / "bob's mug" != parsed(lines[0][0]).out
    with pytest.raises(subprocess.CalledProcessError):
        compiled("flamenco-captures.js", names=" ,", **settings)

    # A stand-in for ObjectGS, so that the code that starts it runs, too.
    (tmp_path / "backend").mkdir()
    (tmp_path / "backend" / "__init__.py").touch()
    (tmp_path / "backend" / "__main__.py").write_text("import sys\nprint(sys.argv[1])\n")
    for held_out, shown in ((True, "evaluate\n"), (False, "")):
        write_views(options.out, held_out=held_out)
        run = subprocess.run([sys.executable, *evaluate], check=True, capture_output=True, text=True)
        assert run.stdout == shown
    (tmp_path / "backend" / "__main__.py").write_text("import os, sys\nsys.exit(int(os.environ['CODE']))\n")
    for meshes, code, expected in MESH_ENDS:
        write_meshes_json(options.out, meshes)
        environment = {**os.environ, "CODE": code}
        ran = subprocess.run([sys.executable, *mesh], check=False, env=environment, capture_output=True)
        assert ran.returncode == expected


def test_code_that_starts_the_backend_runs_it_from_any_folder(tmp_path):
    """The templates for Flamenco and OpenJD have the same."""
    start = start_of("flamenco-cells.js")
    assert start == start_of("flamenco-captures.js")
    template = json.loads((FARM / "openjd-cells.json").read_text())
    assert start == next(p["default"] for p in template["parameterDefinitions"] if p["name"] == "Start")
    words = [sys.executable, "-c", start, str(FARM.parents[1]), "merge", "--help"]
    shown = subprocess.run(words, cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert "usage: python -m backend merge" in shown


def test_openjd_template_trains_cells_between_split_and_merge(tmp_path):
    template = json.loads((FARM / "openjd-cells.json").read_text())
    values = {p["name"]: str(p.get("default", "/path")) for p in template["parameterDefinitions"]}
    # A stand-in for ObjectGS, so that the code that starts it runs, too.
    (tmp_path / "backend").mkdir()
    (tmp_path / "backend" / "__init__.py").touch()
    (tmp_path / "backend" / "__main__.py").write_text("import json, sys\nprint(json.dumps(sys.argv[1:]))\n")
    values |= {"Capture": "/here/capture", "Out": "/o", "ObjectGS": str(tmp_path), "Cells": "3"}
    steps = {step["name"]: step for step in template["steps"]}
    assert {name: [d["dependsOn"] for d in step.get("dependencies", [])] for name, step in steps.items()} == {
        "Train": [], "Split": ["Train"], "Cell": ["Split"], "Merge": ["Cell"]
    }  # fmt: skip

    def run(step, cell=""):
        filled = [
            re.sub(r"{{(Task\.)?Param\.(\w+)}}", lambda m: cell if m[1] else values[m[2]], word)
            for word in step["script"]["actions"]["onRun"]["args"]
        ]
        shown = subprocess.run([sys.executable, *filled], check=True, capture_output=True, text=True).stdout
        return build_parser().parse_args(json.loads(shown))

    (tasks,) = steps["Cell"]["parameterSpace"]["taskParameterDefinitions"]
    assert (tasks["name"], tasks["range"]) == ("Cell", "1-{{Param.Cells}}")
    assert [run(steps["Cell"], number).cell for number in ("1", values["Cells"])] == [0, int(values["Cells"]) - 1]
    found = [run(step, "1") for step in steps.values()]
    assert [o.command for o in found] == ["train", "split", "train-cell", "merge"] and found[1].cells == 3
    assert all(o.capture == Path(values["Capture"]) for o in found), "each session may have another path of it"
    kinds = {p["name"]: p.get("dataFlow") for p in template["parameterDefinitions"]}
    assert kinds["Out"] == "NONE", "steps write to one folder, not to attachments of their own"


def test_openjd_template_measures_each_capture_in_a_task(tmp_path):
    template = json.loads((FARM / "openjd-captures.json").read_text())
    values = {p["name"]: str(p["default"]) for p in template["parameterDefinitions"] if "default" in p}
    kinds = {p["name"]: p.get("dataFlow") for p in template["parameterDefinitions"]}
    assert kinds["Captures"] == kinds["Out"] == "NONE", "workers share the folders"
    (step,) = template["steps"]
    (tasks,) = step["parameterSpace"]["taskParameterDefinitions"]
    assert (tasks["name"], tasks["range"]) == ("Capture", "1-{{Param.Count}}")
    (script,) = step["script"]["embeddedFiles"]
    assert "{{" not in script["data"], "values that are inserted into code would have to be quoted"
    (tmp_path / script["filename"]).write_text(script["data"])

    # A stand-in for ObjectGS that trains by copying the cameras.json of the capture.
    (tmp_path / "backend" / "cli").mkdir(parents=True)
    (tmp_path / "backend" / "__init__.py").touch()
    (tmp_path / "backend" / "cli" / "main.py").write_text(
        "import json, os, shutil\n"
        "def main(words):\n"
        "    print(json.dumps(words), flush=True)\n"
        "    if words[0] == 'train':\n"
        "        shutil.copytree(words[1], words[3], dirs_exist_ok=True)\n"
        "    return int(os.environ['CODE']) if words[0] == os.environ.get('FAILS') else 0\n"
    )
    captures = write_captures(tmp_path / "my captures")
    values |= {"Captures": str(captures), "Out": str(tmp_path / "out"), "ObjectGS": str(tmp_path), "Count": "2"}
    values |= {"Minutes": "7.5"}

    def run(number, count="2", fails="", code="3"):
        own = {
            **{f"Param.{name}": value for name, value in {**values, "Count": count}.items()},
            "Task.Param.Capture": number, f"Task.File.{script['name']}": str(tmp_path / script["filename"]),
        }  # fmt: skip
        words = step["script"]["actions"]["onRun"]["args"]
        filled = [re.sub(r"{{([\w.]+)}}", lambda match: own[match[1]], word) for word in words]
        done = subprocess.run(
            [sys.executable, *filled], check=False, capture_output=True, text=True,
            env={**os.environ, "FAILS": fails, "CODE": code},
        )  # fmt: skip
        return done.returncode, [json.loads(line) for line in done.stdout.splitlines()], done.stderr

    for number, name, expected in (("1", "a $b", ["train", "mesh", "report"]), ("2", "b's", EACH_CAPTURE)):
        code, lines, _ = run(number)
        assert code == 0 and commands_of(lines) == expected
        options = [build_parser().parse_args(words) for words in lines]
        assert (options[0].out, options[0].minutes) == (tmp_path / "out" / name, 7.5)
        assert {o.capture for o in options} == {captures / name}, "each worker may have another path of it"
    code, lines, _ = run("2", fails="mesh")
    assert code == 3 and commands_of(lines) == ["train", "mesh"]
    for meshes, code, expected in MESH_ENDS:
        write_meshes_json(tmp_path / "out" / "b's", meshes)
        ended, lines, _ = run("2", fails="mesh", code=code)
        assert ended == expected and commands_of(lines) == (EACH_CAPTURE[:2] if expected else EACH_CAPTURE)
    code, lines, error = run("1", count="3")
    assert code and not lines and "2 captures instead of 3" in error, "a wrong number would leave captures out"


def test_slurm_script_submits_cells_as_an_array(tmp_path):
    if sys.platform == "win32":
        pytest.skip("the script is for bash")
    log, stub = tmp_path / "log", tmp_path / "sbatch"
    # With the numbers of a site of several clusters. A wrapped command is run by sh, which shows its words.
    stub.write_text(
        f'#!/bin/bash\nprintf "%s\\n" "${{*//$\'\\n\'/ }}" >> {log}\n'
        f'while [ $# -gt 0 ]; do [ "$1" = --wrap ] && sh -c "$2" >> {tmp_path}/wrapped; shift; done\n'
        f'echo "$(wc -l < {log});east"\n'
    )
    stub.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHON": "echo", "LC_ALL": "C"}
    words = [str(FARM / "slurm-cells.sh"), "/my café's", "/o", "3", "10", "20", "--partition=gpu", "--export=NONE"]
    shown = subprocess.run(words, check=True, capture_output=True, env=environment, text=True).stdout
    assert shown.split() == ["3"]
    train, cells, merge = log.read_text().splitlines()
    assert all("--partition=gpu" in line and "--export=ALL" not in line for line in (train, cells, merge))
    assert (tmp_path / "wrapped").read_text(encoding="utf-8").splitlines() == [
        "-m backend train /my café's --out /o --minutes 10", "-m backend split /o --cells 3", "-m backend merge /o"
    ]  # fmt: skip
    assert "--dependency=afterok:1 " in cells and "--array=0-2" in cells
    assert "--dependency=afterok:2 " in merge
    del environment["PYTHON"]
    task = subprocess.run(
        [words[0], *cells.split("slurm-cells.sh ")[1].split()], check=True, capture_output=True, text=True,
        env={**environment, "SLURM_ARRAY_TASK_ID": "2"},
    )  # fmt: skip
    arguments = task.stdout.split()
    assert arguments[:2] == ["-m", "backend"] and build_parser().parse_args(arguments[2:]).cell == 2


def test_slurm_script_submits_captures_as_an_array(tmp_path):
    if sys.platform == "win32":
        pytest.skip("the script is for bash")
    captures, out = write_captures(tmp_path / "my captures"), tmp_path / "out"
    log, stub, python = tmp_path / "log", tmp_path / "sbatch", tmp_path / "my python"
    stub.write_text(f'#!/bin/bash\nprintf "%s\\n" "$@" > {log}\n')
    # Trains by copying the cameras.json of the capture.
    python.write_text(
        f'#!/bin/bash\n(printf "%s\\t" "$@"; echo) >> {tmp_path}/run\n'
        'if [ "$3" = train ]; then mkdir -p "$6" && cp "$4/cameras.json" "$6"; fi\n'
        'if [ "$3" = "${FAILS:-}" ]; then exit "$CODE"; fi\n'
    )
    stub.chmod(0o755)
    python.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}", "PYTHON": str(python), "LC_ALL": "C"}
    script = str(FARM / "slurm-captures.sh")
    words = [script, f"{captures}/", str(out), "7.5", "--partition=gpu"]
    subprocess.run(words, check=True, env=environment)
    submitted = log.read_text().splitlines()
    options, element = submitted[: submitted.index(script)], submitted[submitted.index(script) :]
    assert {"--partition=gpu", "--array=0-1", f"--chdir={Path.cwd()}"} <= set(options)
    del environment["PYTHON"]

    def run(number, fails="", code="3"):
        (tmp_path / "run").unlink(missing_ok=True)
        own = {"SLURM_ARRAY_TASK_ID": number, "FAILS": fails, "CODE": code}
        code = subprocess.run(element, check=False, env={**environment, **own}).returncode
        lines = [line.split("\t")[:-1] for line in (tmp_path / "run").read_text().splitlines()]
        assert all(words[:2] == ["-m", "backend"] for words in lines)
        return code, [words[2:] for words in lines]

    for number, name, expected in (("0", "a $b", ["train", "mesh", "report"]), ("1", "b's", EACH_CAPTURE)):
        code, lines = run(number)
        assert code == 0 and commands_of(lines) == expected
        options = build_parser().parse_args(lines[0])
        assert (options.capture, options.out, options.minutes) == (captures / name, out / name, 7.5)
    code, lines = run("1", fails="mesh")
    assert code == 3 and commands_of(lines) == ["train", "mesh"]
    for meshes, code, expected in MESH_ENDS:
        write_meshes_json(out / "b's", meshes)
        ended, lines = run("1", fails="mesh", code=code)
        assert ended == expected and commands_of(lines) == (EACH_CAPTURE[:2] if expected else EACH_CAPTURE)
    nothing = subprocess.run(
        [script, str(out), "/o", "1"], check=False, capture_output=True, env=environment, text=True
    )
    assert nothing.returncode and "images/" in nothing.stderr
