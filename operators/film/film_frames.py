# SPDX-License-Identifier: GPL-3.0-or-later
"""Render film frames: the splats through the scene's camera, frame by frame, in the background."""

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.shot import NAME, write_shot
from ...objectgs_addon import film, scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.film.properties import folder_of, samples_of
from ...objectgs_addon.running import background
from ..common import need
from ..common.jobs import store_edits
from ..common.reporting import reports_errors
from .output_folder import UsesOutputFolder


class FilmFrames(UsesOutputFolder, bpy.types.Operator):
    bl_idname = "objectgs.film_frames"
    bl_label = "Render Film Frames"
    bl_description = (
        "Render the splats with all edits through the scene's camera over its frame range, in the "
        "background: color, depth and object mattes as EXR. Frames that would not change are skipped"
    )
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not (need.backend(cls) and need.reconstruction(cls, context) and need.idle(cls, context)):
            return False
        if not need.splats(cls, context):
            return False
        if context.scene.camera is None:
            cls.poll_message_set("The scene has no camera; press New Camera from View in the panel Render")
            return False
        return True

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        root, owner = need.active_root(context), context.scene
        self.remember_output(context)
        reconstruction = scene.folder_of(root)
        folder = folder_of(owner, reconstruction)
        if not folder.is_absolute():
            raise InputError(
                f"The output folder {folder} is relative, or without a drive; save the .blend first, or choose another"
            )
        settings = owner.objectgs_film
        frames = range(owner.frame_start, owner.frame_end + 1, owner.frame_step)
        manager = context.window_manager
        manager.progress_begin(0, max(len(frames), 1))
        try:
            store_edits(root)
            shot = film.shot_of(
                owner,
                context.view_layer,
                root,
                frames,
                samples_of(owner, settings.subframes),
                lambda done, _total: manager.progress_update(done),
            )
            folder.mkdir(parents=True, exist_ok=True)
            write_shot(folder / NAME, shot)
            for problem in (film.ignored_settings(owner), film.empty_frames(shot, context.view_layer, root)):
                if problem is not None:
                    self.report({"WARNING"}, problem)
        finally:
            manager.progress_end()
        options = ["--png"] if settings.png else []
        job = locations.backend_job(
            f"Film of {root.name}",
            "film",
            reconstruction,
            "film",
            str(reconstruction),
            "--shot",
            str(folder / NAME),
            "--out",
            str(folder),
            *options,
        )
        return background.submit(job, owner, self.report)


CLASSES = (FilmFrames,)
