"""The job templates of examples/farm/: their command lines are those of the backend, in the right order."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from backend.cli.parser import build_parser

FARM = Path(__file__).resolve().parents[2] / "examples" / "farm"

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
    assert all(words[:2] == ["-b", "-P"] and words[4] == "film" for words in arguments)


def test_code_that_starts_the_backend_runs_it_from_any_folder(tmp_path):
    """The templates for Flamenco and OpenJD have the same."""
    script = (FARM / "flamenco-cells.js").read_text()
    start = "".join(re.findall(r'"([^"]*)"', script[script.index("const START") : script.index("function compileJob")]))
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
