# SPDX-License-Identifier: GPL-3.0-or-later
"""Take the pictures of the manual, docs/manual/images/, in the first Blender that `harness.blenders` finds.

.venv/bin/python -m tests.window.manual_pictures [--demo FOLDER] [--only PART ...]

FOLDER is the result of `make demo`, by default build/demo; it is copied, not changed. PART is a key of `PARTS`.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image, ImageFilter

from . import demo_views, harness
from .test_workflow import IDLE, script, wait

IMAGES = harness.ROOT / "docs" / "manual" / "images"
SIZE = (1320, 880)
WIDEST = 1000
QUALITY = 82
BLURRED = (11, 30)
"""Photos of the demo, by number, that are blurred for the picture of weak poses."""
AWAY = (300, 862)
"""A mouse position without effect on the image."""
PREFERENCES = (260, 168, 980, 512)
"""Where the window of the preferences, which opens over the other one, shows those of the extension."""


def view(blender: harness.Blender, distance: float, tilt: float = 68.0) -> None:
    """Look at the table from `distance` meters, with the table left of the sidebar."""
    demo_views.view(blender, distance, tilt=tilt, turn=105.0)
    blender.run(f"window_context()['area'].spaces.active.region_3d.view_location.y = {0.1 * distance}")


class Window:
    """Blender's window with the demo, whose result is the folder `demo`, and a folder for a new reconstruction."""

    def __init__(self, blender: harness.Blender, demo: Path, folder: Path) -> None:
        self.blender, self.demo, self.folder = blender, demo, folder

    def save(self, name: str, box: tuple[int, int, int, int] | None = None, mouse: bool = False) -> None:
        """Write a picture of a part of the window, by default the 3D viewport; `mouse` leaves the mouse where it is."""
        if not mouse:
            self.blender.move(*AWAY)
        time.sleep(3.0)
        with Image.open(self.blender.shot(f"manual-{name}")) as image:
            picture = image.convert("RGB").crop(box or self.region("WINDOW"))
        if picture.width > WIDEST:
            size = (WIDEST, round(picture.height * WIDEST / picture.width))
            picture = picture.resize(size, Image.Resampling.LANCZOS)
        IMAGES.mkdir(parents=True, exist_ok=True)
        picture.save(IMAGES / f"{name}.jpg", quality=QUALITY, optimize=True)
        print(name, f"{(IMAGES / f'{name}.jpg').stat().st_size // 1000} kB", flush=True)

    def region(self, kind: str) -> tuple[int, int, int, int]:
        """Return the box of a region of the 3D viewport: its sidebar is UI, its toolbar TOOLS."""
        left, top, right, bottom = self.blender.run(f"""
            context = window_context()
            region = next(region for region in context["area"].regions if region.type == {kind!r})
            height = context["window"].height
            top = height - region.y - region.height
            result = [region.x, top, region.x + region.width, top + region.height]
        """)
        return left, top, right, bottom

    def panels(self, *names: str) -> None:
        """Show only these panels, such as EditPanel, below the first one, and scroll to the top."""
        self.blender.run(
            script(f"""
            panels = sys.modules[f"{{addon.__name__}}.panels"]
            for cls in panels.CLASSES:
                if issubclass(cls, bpy.types.Panel) and hasattr(cls, "poll"):
                    cls.poll = classmethod(lambda cls, _context: cls.__name__ in {names!r})
            context = window_context()
            region = next(region for region in context["area"].regions if region.type == "UI")
            region.tag_redraw()
        """)
        )
        time.sleep(1.5)

    def sidebar(self, name: str, height: int) -> None:
        """Save a picture of the upper `height` pixels of the sidebar's panels."""
        left, top, right, _ = self.region("UI")
        self.save(name, (left, top, right, top + height))

    def tool(self, name: str) -> None:
        """Choose a tool of the toolbar."""
        self.blender.run(f"""
            with bpy.context.temp_override(**window_context()):
                bpy.ops.wm.tool_set_by_id(name={name!r})
        """)

    def spot(self, name: str) -> tuple[float, float]:
        """Return the pixel in the window where the middle of an object is."""
        x, y = self.blender.run(
            script(f"""
            from bpy_extras.view3d_utils import location_3d_to_region_2d
            from mathutils import Vector
            context = window_context()
            item = next(item for item in root.objectgs.objects if item.name == {name!r})
            collection = scene.object_collections(root)[scene.from_stored(item.object_id)]
            splats = next(part for part in scene.parts_of(collection) if scene.kind_of(part) == "splats")
            region, region3d = context["region"], context["area"].spaces.active.region_3d
            region3d.update()
            spots = [splats.matrix_world @ vertex.co for vertex in splats.data.vertices]
            spots = [spot for spot in (location_3d_to_region_2d(region, region3d, spot) for spot in spots) if spot]
            x, y = (sorted(spot[axis] for spot in spots)[len(spots) // 2] for axis in (0, 1))
            result = [region.x + x, context["window"].height - region.y - y]
        """)
        )
        return x, y

    def do(self, body: str, timeout: float = 300.0) -> None:
        """Run a script with the names of the workflow's tests, and wait until all jobs have ended."""
        self.blender.run(script(body), timeout=timeout)
        wait(self.blender, IDLE, timeout)


OPEN_CLOSED_PANELS = """
    for cls in sys.modules[f"{addon.__name__}.panels"].CLASSES:
        if "DEFAULT_CLOSED" in getattr(cls, "bl_options", ()):
            bpy.utils.unregister_class(cls)
            cls.bl_options = set()
            bpy.utils.register_class(cls)
"""
SHOW_SPLATS = """
    scene.show_kinds(root, "splats")
    for layer in bpy.context.view_layer.layer_collection.children[root.name].children:
        if layer.collection.name == "backdrop":
            layer.hide_viewport = False
"""
ACTIVATE = """
    def activate(name):
        names = [item.name for item in root.objectgs.objects]
        root.objectgs.active_object = names.index(name)
        call(bpy.ops.objectgs.select_object)
"""


def setting_up(window: Window, python: str) -> None:
    """Save the panel and the preferences without a backend, and the help."""
    blender = window.blender
    preferences = f'bpy.context.preferences.addons["{harness.PACKAGE}"].preferences'
    blender.run(f"{preferences}.backend_python = ''")
    folder = blender.run(f"result = {preferences}.reconstructions")
    blender.run(f"{preferences}.reconstructions = ''")
    window.panels()
    window.sidebar("first-panel", 305)
    blender.run(f"""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.preferences.addon_show(module="{harness.PACKAGE}")
    """)
    blender.run("""
        window = bpy.context.window_manager.windows[1]
        area = window.screen.areas[0]
        region = next(region for region in area.regions if region.type == "WINDOW")
        with bpy.context.temp_override(window=window, area=area, region=region):
            for _ in range(3):
                bpy.ops.view2d.scroll_down(deltay=-40)
    """)
    window.save("preferences", PREFERENCES)
    blender.run(f"""
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[1]):
            bpy.ops.wm.window_close()
        {preferences}.backend_python = {python!r}
        {preferences}.reconstructions = {folder!r}
    """)


def help_popover(window: Window) -> None:
    """Save the help that the question mark opens."""
    left, top, right, _ = window.region("UI")
    window.blender.click(right - 78, top + 15)
    window.save("help", (left, top, SIZE[0], top + 340), mouse=True)
    window.blender.key("Escape")


def viewing(window: Window) -> None:
    """Save the splats with an object outlined, and in the colors of the objects."""
    blender = window.blender
    window.panels()
    view(blender, 1.25)
    window.tool("objectgs.pick")
    x, y = window.spot("mug")
    blender.move(x - 8, y)
    time.sleep(3.0)
    blender.move(x, y)
    window.save("pick", mouse=True)
    window.tool("builtin.select_box")
    window.do("owner.objectgs.colors = 'object'")
    window.save("colors")
    window.do("owner.objectgs.colors = 'photo'")


def editing(window: Window) -> None:
    """Save the panel Edit, and an object removed with its hole filled, others recolored and duplicated."""
    blender = window.blender
    view(blender, 1.25)
    window.panels("ObjectsPanel", "EditPanel")
    window.do(ACTIVATE + "    activate('monkey')\n    call(bpy.ops.object.select_all, action='DESELECT')")
    window.panels("EditPanel")
    window.sidebar("edit-panel", 640)
    window.do(
        ACTIVATE
        + """
    from mathutils import Matrix
    rows = {item.name: item for item in root.objectgs.objects}
    rows["monkey"].hue, rows["monkey"].saturation = 0.5, 1.2
    activate("teapot")
    with bpy.context.temp_override(**window_context()):
        bpy.ops.objectgs.duplicate_object("EXEC_DEFAULT")
    copy = bpy.context.active_object
    copy.matrix_world = Matrix.Translation((0.25, -0.42, 0.0)) @ copy.matrix_world
    activate("books")
    with bpy.context.temp_override(**window_context()):
        bpy.ops.objectgs.remove_object("EXEC_DEFAULT", fill=True)
    """
    )
    window.save("edited")
    window.do("bpy.ops.object.select_all(action='DESELECT')")


def marking(window: Window) -> None:
    """Save two marked objects of the demo, as if it had no masks, and the stroke on the next one."""
    blender, spots = window.blender, {}
    view(blender, 1.1)
    for name in ("monkey", "vase", "ring"):
        spots[name] = window.spot(name)
    folder, capture = window.folder.parent / "marked", window.folder.parent / "unlabeled"
    shutil.copytree(window.demo / "capture", capture, ignore=shutil.ignore_patterns("masks", "labels.json", "truth"))
    shutil.copytree(window.demo, folder, ignore=shutil.ignore_patterns("capture", "cache", "meshes", "*.blend", "film"))
    for name in ("objectgs.json", "cameras.json"):
        path = folder / name
        path.write_text(path.read_text().replace(str(window.demo / "capture"), str(capture)))
    (folder / "objects.json").unlink()
    before = blender.run(script("result = root.name"))
    window.do(f"bpy.data.collections[{before!r}].hide_viewport = True")
    demo_views.open_demo(blender, folder)
    window.panels("MarkingPanel")
    view(blender, 1.1)
    window.do("call(bpy.ops.objectgs.start_marking)")
    pointing = f"sys.modules['{harness.PACKAGE}.objectgs_addon.running.pointing'].state()"
    for name in ("monkey", "vase"):
        wait(blender, f"{pointing} == (1.0, False)", timeout=480)
        x, y = spots[name]
        blender.drag((x - 25, y - 30), (x + 25, y + 30))
        blender.key("Tab")
    wait(blender, f"{pointing} == (1.0, False)")
    x, y = spots["ring"]
    blender.move(x - 30, y - 45)
    blender._tool("xdotool", "mousedown", "1")
    blender.move(x + 30, y - 45)
    window.save("mark", mouse=True)
    blender._tool("xdotool", "mouseup", "1")
    window.do(f"""
    call(bpy.ops.objectgs.stop_marking)
    bpy.data.collections.remove(root)
    owner.objectgs.active = bpy.data.collections[{before!r}]
    owner.objectgs.active.hide_viewport = False
    """)


def splats(window: Window) -> None:
    """Save single splats that are selected with the lasso, and a crop box."""
    blender = window.blender
    window.panels("SplatsPanel")
    view(blender, 0.8)
    window.tool("objectgs.select_splats")
    window.do("owner.objectgs.splat_shape = 'BRUSH'; owner.objectgs.splat_depth = 'VISIBLE'")
    x, y = window.spot("monkey")
    blender.drag((x - 40, y - 10), (x + 50, y + 10))
    blender.move(x + 50, y + 30)
    window.save("select-splats", mouse=True)
    window.do("call(bpy.ops.objectgs.select_all_splats, action='DESELECT')")
    window.tool("builtin.select_box")
    view(blender, 3.2, tilt=60.0)
    window.do("""
    with bpy.context.temp_override(**window_context()):
        bpy.ops.objectgs.add_crop_box("EXEC_DEFAULT")
    box = bpy.context.active_object
    box.location, box.scale = (0.0, 0.0, 0.14), (0.6, 0.6, 0.22)
    """)
    window.save("crop-box")
    window.do("call(bpy.ops.objectgs.apply_crop)")
    window.save("cropped")
    window.do("call(bpy.ops.objectgs.remove_crop)")


def meshes(window: Window) -> None:
    """Save the meshes and their panel."""
    blender = window.blender
    window.panels("MeshesPanel")
    view(blender, 1.25)
    window.do("scene.show_kinds(root, 'meshes')")
    blender.run("""
        space = window_context()["area"].spaces.active
        space.shading.type = "MATERIAL"
    """)
    time.sleep(15.0)
    window.save("meshes")
    blender.run("""
        space = window_context()["area"].spaces.active
        space.shading.type = "SOLID"
    """)
    window.do("scene.show_kinds(root, 'splats')")


def rendering(window: Window) -> None:
    """Save the panels Render and Film, and a film frame."""
    window.panels("RenderPanel", "FilmPanel")
    window.do("owner.view_settings.view_transform = 'AgX'")
    window.sidebar("render-panel", 610)
    window.do("call(bpy.ops.objectgs.set_up_render); owner.render.resolution_percentage = 200")
    window.do("owner.frame_end, owner.objectgs_film.png = 1, True; call(bpy.ops.objectgs.film_frames)")
    frames = window.blender.run(
        script("""
        from pathlib import Path
        result = [str(path) for path in sorted((Path(scene.folder_of(root)) / "film").rglob("*.png"))]
    """)
    )
    with Image.open(frames[0]) as image:
        image.convert("RGB").save(IMAGES / "film-frame.jpg", quality=QUALITY, optimize=True)


def browser(window: Window, call: str, name: str, box: tuple[int, int, int, int]) -> None:
    """Save a part of the file browser that a script opens, and close it."""
    blender = window.blender
    blender.run('bpy.context.preferences.view.filebrowser_display_type = "SCREEN"')
    window.do(call)
    time.sleep(3.0)
    window.save(name, box)
    blender.move(SIZE[0] / 2, SIZE[1] / 2)
    blender.key("Escape")
    time.sleep(2.0)


def exporting(window: Window) -> None:
    """Save the options of the export of splats."""
    window.panels("ExportPanel")
    browser(window, "call(bpy.ops.objectgs.export_splats)", "export", (SIZE[0] - 270, 58, SIZE[0], 190))


def from_photos(window: Window) -> None:
    """Save the file browser of photos, and their import, in which two photos of the demo are blurred."""
    blender, place = window.blender, window.folder.parent
    photos = place / "photos"
    photos.mkdir(parents=True)
    for number, path in enumerate(sorted((window.demo / "capture" / "images").iterdir())):
        with Image.open(path) as image:
            blurred = number in BLURRED
            (image.filter(ImageFilter.GaussianBlur(3.0)) if blurred else image).save(photos / path.name)
    window.panels()
    window.do("""
    with bpy.context.temp_override(**window_context()):
        bpy.ops.wm.read_homefile(use_empty=True, app_template="")
    """)
    opened = f"call(bpy.ops.objectgs.import_photos, directory={f'{photos}/'!r})"
    browser(window, opened, "import-photos", (0, 0, *SIZE))
    window.do(
        f"""
    with bpy.context.temp_override(**window_context()):
        bpy.ops.objectgs.import_photos(
            "EXEC_DEFAULT", directory={str(photos)!r}, folder={str(place / "posed")!r})
    """,
        timeout=600,
    )
    wait(blender, f"{IDLE} and root is not None")
    demo_views.show_sidebar(blender)
    view(blender, 3.4, tilt=60.0)
    window.save("posed")


def from_capture(window: Window) -> None:
    """Save an imported capture, its objects, and its training."""
    blender, capture, folder = window.blender, str(window.demo / "capture"), str(window.folder)
    window.panels()
    window.do(f"""
    with bpy.context.temp_override(**window_context()):
        bpy.ops.wm.read_homefile(use_empty=True, app_template="")
        bpy.ops.objectgs.import_capture("EXEC_DEFAULT", directory={capture!r}, folder={folder!r})
    """)
    wait(blender, f"{IDLE} and root is not None")
    demo_views.show_sidebar(blender)
    view(blender, 3.4, tilt=60.0)
    window.save("imported")
    window.do("call(bpy.ops.objectgs.assign_objects)")
    wait(blender, f"{IDLE} and len(root.objectgs.objects)")
    window.panels("ObjectsPanel")
    view(blender, 1.4)
    window.save("objects")
    window.panels("TrainPanel", "PlanPanel")
    window.do("call(bpy.ops.objectgs.analyze_capture)")
    window.sidebar("plan", 700)
    window.panels("TrainPanel")
    blender.run(script("root.objectgs.length = 'standard'; call(bpy.ops.objectgs.train)"))
    wait(blender, "(job := background.queue.running) is not None and job.step and job.progress > 0.6", 600)
    window.save("training")
    window.do("call(bpy.ops.objectgs.stop_job)")


PARTS = {
    "view": viewing,
    "meshes": meshes,
    "mark": marking,
    "edit": editing,
    "splats": splats,
    "render": rendering,
    "export": exporting,
    "capture": from_capture,
    "photos": from_photos,
}


def main() -> None:
    """Take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demo", type=Path, default=harness.ROOT / "build" / "demo")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    options = parser.parse_args()
    subprocess.run(["make", "zip"], cwd=harness.ROOT, check=True, stdout=subprocess.DEVNULL)
    archive = max((harness.ROOT / "build").glob("objectgs-*.zip"), key=lambda path: path.stat().st_mtime)
    name, (command, variables) = next(iter(harness.blenders().items()))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        shutil.copytree(
            options.demo, folder / "tabletop", ignore=shutil.ignore_patterns("capture", "cache", "*.blend", "film")
        )
        blender = harness.Blender(
            command, variables, folder / "blender", harness.ROOT / "build" / "window" / name, SIZE
        )
        window = Window(blender, options.demo.resolve(), folder / "new" / "tabletop")
        try:
            blender.wait_for("True", timeout=180)
            blender.install(archive, Path(sys.executable))
            blender.run(script(OPEN_CLOSED_PANELS))
            demo_views.show_sidebar(blender)
            setting_up(window, sys.executable)
            help_popover(window)
            demo_views.open_demo(blender, folder / "tabletop")
            window.do(SHOW_SPLATS)
            for part in options.only:
                PARTS[part](window)
        finally:
            blender.close()


if __name__ == "__main__":
    main()
