// SPDX-License-Identifier: GPL-3.0-or-later
// A job type for Flamenco: a large capture is trained in cells, each by a worker, and merged.
// Copy this file into the folder `scripts` beside the Flamenco Manager.

const JOB_TYPE = {
    label: "ObjectGS: Train in Cells",
    description: "Trains a coarse model of a capture, divides it into cells that workers train, and merges them",
    settings: [
        { key: "capture", type: "string", required: true, subtype: "dir_path",
          description: "Folder with images, cameras and masks, as the workers see it" },
        { key: "out", type: "string", required: true, subtype: "dir_path",
          description: "Folder of the reconstruction, as the workers see it" },
        { key: "cells", type: "int32", default: 4, description: "Number of cells" },
        { key: "coarse_minutes", type: "float", default: 20, description: "Training time of the coarse model" },
        { key: "cell_minutes", type: "float", default: 60, description: "Training time of each cell" },
        { key: "coarse_anchors", type: "int32", default: 200000, description: "Most anchors of the coarse model" },
        { key: "python", type: "string", default: "{objectgs_python}",
          description: "Python of the backend; a variable of Flamenco can differ between workers" },
        { key: "objectgs", type: "string", default: "{objectgs}", subtype: "dir_path",
          description: "Folder of ObjectGS, with the folder backend" },
    ],
};

// Runs `python -m backend` from any working folder.
const START = "import runpy, sys; sys.path.insert(0, sys.argv.pop(1)); "
    + "runpy.run_module('backend', run_name='__main__', alter_sys=True)";

function compileJob(job) {
    const settings = job.settings;

    function add(name, args, dependencies) {
        const task = author.Task(name, "misc");
        task.addCommand(author.Command("exec", {
            exe: settings.python,
            args: ["-c", START, settings.objectgs].concat(args),
        }));
        dependencies.forEach((dependency) => task.addDependency(dependency));
        job.addTask(task);
        return task;
    }

    const train = add("train", [
        "train", settings.capture, "--out", settings.out, "--minutes", String(settings.coarse_minutes),
        "--max-anchors", String(settings.coarse_anchors),
    ], []);
    const split = add("split", ["split", settings.out, "--cells", String(settings.cells)], [train]);
    const cells = [];
    for (let cell = 0; cell < settings.cells; cell++) {
        cells.push(add(`cell-${cell}`, [
            "train-cell", settings.out, "--cell", String(cell), "--minutes", String(settings.cell_minutes),
        ], [split]));
    }
    add("merge", ["merge", settings.out], cells);
}
