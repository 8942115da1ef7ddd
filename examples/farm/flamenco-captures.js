// SPDX-License-Identifier: GPL-3.0-or-later
// A job type for Flamenco: the captures of a folder are trained, meshed and measured, each by a worker.
// Copy this file into the folder `scripts` beside the Flamenco Manager.

const JOB_TYPE = {
    label: "ObjectGS: Folder of Captures",
    description: "Trains each capture of a folder, extracts its meshes, and writes its report",
    settings: [
        { key: "captures", type: "string", required: true, subtype: "dir_path",
          description: "Folder with the captures, as the workers see it" },
        // Job types cannot list folders.
        { key: "names", type: "string", required: true,
          description: "Names of the captures' folders, separated by commas" },
        { key: "out", type: "string", required: true, subtype: "dir_path",
          description: "Folder of the reconstructions, which are named like the captures, as the workers see it" },
        { key: "minutes", type: "float", default: 30, description: "Training time of each capture" },
        { key: "python", type: "string", default: "{objectgs_python}",
          description: "Python of the backend; a variable of Flamenco can differ between workers" },
        { key: "objectgs", type: "string", default: "{objectgs}", subtype: "dir_path",
          description: "Folder of ObjectGS, with the folder backend" },
    ],
};

// Runs `python -m backend` from any working folder.
const START = "import runpy, sys; sys.path.insert(0, sys.argv.pop(1)); "
    + "runpy.run_module('backend', run_name='__main__', alter_sys=True)";

// Does so only if a view is held out, since `evaluate` refuses other captures.
const START_IF_HELD_OUT = "import json, os, sys; "
    + "cameras = json.load(open(os.path.join(sys.argv[-1], 'cameras.json'), encoding='utf-8'))['cameras']; "
    + "any(camera['held_out'] for camera in cameras) or sys.exit(); " + START;

// Goes on after `mesh` if it has tried every object: without a surface, none has a mesh, but the splats are measured.
const START_MESH = "import json, os, sys\n"
    + "try:\n    " + START + "\n"
    + "except SystemExit as end:\n"
    + "    path = os.path.join(sys.argv[-1], 'meshes', 'meshes.json')\n"
    + "    if end.code != 2 or not os.path.exists(path) or 'waiting' in json.load(open(path, encoding='utf-8')):\n"
    + "        raise";

function compileJob(job) {
    const settings = job.settings;
    const names = settings.names.split(/[,\n]/).map((name) => name.trim()).filter((name) => name);
    if (!names.length) throw new Error("Enter the names of the captures.");

    for (const name of names) {
        const task = author.Task(name, "misc");
        const out = `${settings.out}/${name}`;
        const add = (start, args) => task.addCommand(author.Command("exec", {
            exe: settings.python,
            args: ["-c", start, settings.objectgs].concat(args),
        }));
        add(START, ["train", `${settings.captures}/${name}`, "--out", out, "--minutes", String(settings.minutes)]);
        add(START_MESH, ["mesh", out]);
        add(START_IF_HELD_OUT, ["evaluate", out]);
        add(START, ["report", out]);
        job.addTask(task);
    }
}
