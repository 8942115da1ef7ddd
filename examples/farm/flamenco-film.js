// SPDX-License-Identifier: GPL-3.0-or-later
// A job type for Flamenco: the frames of a film of edited splats, in ranges.
// Copy this file into the folder `scripts` beside the Flamenco Manager.

const JOB_TYPE = {
    label: "ObjectGS: Film",
    description: "Renders the splats of a scene as OpenEXR images, by ranges of frames",
    settings: [
        { key: "blend", type: "string", required: true, subtype: "file_path",
          description: "The .blend file with the shot, as the workers see it" },
        { key: "out", type: "string", required: true, subtype: "dir_path", description: "Folder of the images" },
        { key: "frames", type: "string", required: true, description: "Frames, such as 1-240 or 1-24,50-80" },
        { key: "dir", type: "string", default: "", subtype: "dir_path",
          description: "The reconstruction folder as the workers see it, if it is not where the .blend has it" },
        { key: "chunk_size", type: "int32", default: 20, description: "Number of frames of a task" },
        { key: "headless", type: "string", default: "{objectgs}/headless.py", subtype: "file_path",
          description: "headless.py of ObjectGS" },
        { key: "python", type: "string", default: "{objectgs_python}", description: "Python of the backend" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    const folder = settings.dir ? ["--dir", settings.dir] : [];
    for (const chunk of frameChunker(settings.frames, settings.chunk_size)) {
        const task = author.Task(`film-${chunk}`, "blender");
        task.addCommand(author.Command("exec", {
            exe: "{blender}",
            args: [
                "-b", "--python-exit-code", "1", "-P", settings.headless, "--", "film", settings.blend, "--out", settings.out,
                "--frames", chunk, "--backend-python", settings.python, ...folder,
            ],
        }));
        job.addTask(task);
    }
}
