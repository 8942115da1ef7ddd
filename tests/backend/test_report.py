"""The report: names that other programs read, null for missing measurements, and images."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
from PIL import Image

from backend.evaluation import comparison, contact_sheet, id_image, save_image, write_report
from backend.evaluation.images import MaskSheet, load_font, shorten
from backend.evaluation.report_plots import plot_curve, plot_objects
from backend.evaluation.report_text import duration
from backend.shared.color.palette import UNLABELED, colors_of, object_colors, to_linear
from backend.shared.errors import InputError
from backend.shared.reconstruction.folder import Reconstruction
from backend.shared.reconstruction.report import Report, complete, read_report
from backend.training.settings import Settings


def a_report():
    return {
        "capture": {"name": "table | top", "images": np.int64(48)},
        "settings": {"minutes": 2.5, "seed": 0, "steps": None},
        "machine": {"cores": 2},
        "left_out": [{"what": "2 images", "why": "not in the COLMAP model"}],
        "stages": [{"name": "train", "seconds": np.float32(150.0), "peak_rss_mb": 1800}],
        "curve": [
            {"seconds": 60.0, "step": 900, "psnr": 30.0, "miou": 0.9},
            {"seconds": 30.0, "step": 400, "psnr": 28.0, "miou": math.nan},
        ],
        "model": {"anchors": 9000, "gaussians": 60_000, "bytes": 5_000_000},
        "quality": {"psnr": np.float64(31.25), "ssim": 0.93, "lpips": math.nan, "miou": 0.97, "mbiou": math.inf},
        "objects": [
            {"id": 70_000, "name": "mug", "iou": 0.96, "anchors": 100},
            {"id": 2, "name": "tea|pot", "iou": None},
        ],
        "views": [{"name": "a.png", "psnr": 31.0}],
    }


@pytest.fixture
def reconstruction(tmp_path):
    return Reconstruction(tmp_path / "out").create()


def strictly(text):
    """Parse standard JSON, without NaN or Infinity."""

    def refuse(word):
        raise AssertionError(f"{word} in JSON")

    return json.loads(text, parse_constant=refuse)


def test_report_json_has_all_keys_and_null_if_unmeasured(reconstruction):
    returned = write_report(reconstruction, Report(**a_report())).as_dict()
    report = strictly(reconstruction.report_json.read_text(encoding="utf-8"))
    assert report == returned
    assert report["quality"] == {
        "psnr": 31.25,
        "psnr_corrected": None,
        "ssim": 0.93,
        "lpips": None,
        "miou": 0.97,
        "miou_all": None,
        "miou_alone": None,
        "mbiou": None,
        "dice": None,
        "accuracy": None,
    }
    assert report["stages"] == [{"name": "train", "seconds": 150.0, "peak_rss_mb": 1800}]
    assert report["objects"][1]["iou"] is None and report["objects"][1]["anchors"] is None
    unmeasured = dict.fromkeys(("vertices", "faces", "watertight", "chamfer", "precision", "recall", "f1"))
    assert report["objects"][0]["mesh"] == unmeasured
    assert [point["seconds"] for point in report["curve"]] == [30.0, 60.0]
    assert report["curve"][0]["miou"] is None and report["curve"][1]["miou_all"] is None
    assert report["views"] == [{"name": "a.png", "psnr": 31.0}]
    assert report["capture"]["images"] == 48


def test_report_is_read_as_written(reconstruction):
    written = write_report(reconstruction, Report(**a_report()))
    assert read_report(reconstruction.folder) == written
    for content in ("[]", '{"quality": [1]}', "{"):
        reconstruction.report_json.write_text(content)
        with pytest.raises(InputError, match=r"report\.json"):
            read_report(reconstruction.folder)


def with_background(zero_is_background):
    report = a_report()
    report["capture"]["supervise_background"] = zero_is_background
    report["quality"]["miou_all"] = 0.95
    report["objects"][0]["iou_all"] = 0.91
    report["views"] = [{"name": f"{i}.png", "miou": 0.9 + i / 100, "miou_all": 0.8 + i / 100} for i in (2, 1, 3)]
    return Report(**report)


@pytest.mark.parametrize(
    ("background", "headline", "per_view", "iou"),
    [
        (True, "mIoU (all) 0.950", "mIoU (all) of single views: median 0.820, lowest 0.810 (1.png)", "0.910"),
        (False, "mIoU (labeled) 0.970", "mIoU (labeled) of single views: median 0.920, lowest 0.910 (1.png)", "0.960"),
    ],
)
def test_report_leads_with_all_pixels_where_zero_is_background(reconstruction, background, headline, per_view, iou):
    report = write_report(reconstruction, with_background(background))
    assert (report.quality["miou"], report.quality["miou_all"]) == (0.97, 0.95) and len(report.views) == 3
    text = reconstruction.report_md.read_text(encoding="utf-8")
    assert f"PSNR 31.25 dB, {headline}, 2 min" in text and per_view in text
    rows = [line.split(" | ")[0] for line in text.splitlines() if line.startswith("| mIoU")]
    assert rows == (["| mIoU (all)", "| mIoU (labeled)"] if background else ["| mIoU (labeled)", "| mIoU (all)"])
    mug = next(line for line in text.splitlines() if "| mug |" in line)
    assert f"| {iou} |" in mug and ("| IoU (all) |" in text) is background


def test_report_has_objects_alone_where_they_were_measured(reconstruction):
    def table_of(report):
        write_report(reconstruction, report)
        text = reconstruction.report_md.read_text(encoding="utf-8")
        return "| mIoU alone |" in text, "| IoU alone |" in text, "| 0.875 |" in text

    report = with_background(True)
    assert table_of(report) == (False, False, False)
    report.quality["miou_alone"] = report.objects[0]["iou_alone"] = 0.875
    assert table_of(report) == (True, True, True)


def test_report_of_earlier_version_has_no_miou_all(reconstruction):
    """Reports, evaluations and curves without miou_all lead with miou, whatever 0 means."""
    write_report(reconstruction, with_background(True))
    content = json.loads(reconstruction.report_json.read_text())
    for entry in (content["quality"], *content["curve"], *content["views"]):
        entry.pop("miou_all", None)
    for entry in content["objects"]:
        del entry["iou_all"]
    reconstruction.report_json.write_text(json.dumps(content))
    report = read_report(reconstruction.folder)
    assert report.quality["miou_all"] is None and report.lead_miou == "miou" and report.objects[0]["iou_all"] is None
    text = write_report(reconstruction, report) and reconstruction.report_md.read_text(encoding="utf-8")
    assert "mIoU (labeled) 0.970" in text and "| mIoU (all) | — |" in text


def test_objects_without_masks_of_held_out_photos_are_left_out_with_the_reason(reconstruction):
    report = a_report()
    report["quality"] = {"psnr": 28.2, "lpips": None}
    report["curve"] = [{"seconds": 60.0, "step": 900, "psnr": 30.0, "miou": None}]
    report["objects"] = [{"id": 1, "name": "mug", "anchors": 100}]
    report["model"]["trained_steps"] = 1000
    report["views"] = [{"name": f"{i}.png", "psnr": 28.0, "miou": None} for i in range(5)]

    def text_with(**capture):
        write_report(reconstruction, Report(**{**report, "capture": capture}))
        return reconstruction.report_md.read_text(encoding="utf-8")

    text = text_with(masks=7)
    assert "| LPIPS | — |" in text and "mIoU" not in text and "IoU (" not in text and "| Dice" not in text
    assert "Add masks of 0.png, 1.png, 2.png and 2 more with the same IDs" in text
    assert "## PSNR over run time" in text and "![PSNR of held-out views over run time]" in text
    assert "The last measurement was after 900 of 1,000 steps." in text
    assert "the capture has no masks" in text_with(masks=0)
    report["quality"] = {}
    assert "no photo is held out" in text_with(held_out=0) and "| PSNR |" not in text_with(held_out=2)
    assert "run `evaluate`" in text_with(held_out=2)


def test_empty_report_has_only_null(reconstruction):
    report = write_report(reconstruction, Report()).as_dict()
    assert set(report["quality"].values()) == {None}
    assert report["model"] == {"anchors": None, "gaussians": None, "bytes": None}
    assert [report[name] for name in ("left_out", "stages", "curve", "objects")] == [[]] * 4
    assert [report[name] for name in ("capture", "settings", "machine")] == [{}] * 3
    text = reconstruction.report_md.read_text(encoding="utf-8")
    assert "0.00" not in text and "![" not in text
    assert not list(reconstruction.pictures.iterdir())


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"quality": {"psnr": "31"}}, "quality.psnr"),
        ({"quality": {"miou": True}}, "quality.miou"),
        ({"quality": [1]}, "report.quality"),
        ({"stages": {"name": "train"}}, "report.stages"),
        ({"stages": [{"seconds": 1.0}]}, r"stages\[0\] has no name"),
        ({"curve": [{"psnr": 1.0}]}, r"curve\[0\] has no seconds"),
        ({"curve": [{"seconds": math.nan}]}, r"curve\[0\] has no seconds"),
        ({"objects": [{"name": "mug"}]}, r"objects\[0\] has no id"),
        ({"objects": [{"id": 1, "iou": "good"}]}, r"objects\[0\].iou"),
        ({"objects": [{"id": 1, "mesh": 3}]}, r"objects\[0\].mesh"),
        ({"left_out": [{"what": "x"}]}, "has no why"),
        ({"capture": {"x": {1, 2}}}, "report.capture.x"),
        ({"model": {"anchors": "many"}}, "model.anchors"),
    ],
)
def test_invalid_entry_is_reported_and_nothing_written(reconstruction, change, where):
    with pytest.raises(ValueError, match=where):
        write_report(reconstruction, Report(**{**a_report(), **change}))
    assert not reconstruction.report_json.exists() and not reconstruction.report_md.exists()


def test_report_md_shows_figures_images_and_omissions(reconstruction):
    gray = Image.new("RGB", (40, 30), (128, 128, 128))
    write_report(reconstruction, Report(**a_report()), [("View a.png", gray), ("View ../b", gray)], title="Demo")
    text = reconstruction.report_md.read_text(encoding="utf-8")
    for wanted in (
        "# Demo",
        "31.25 dB",
        "0.9700",
        "2 min 30 s",
        "1,800 MB",
        "not in the COLMAP model",
        "60,000",
        "70000",
    ):
        assert wanted in text, wanted
    assert "| LPIPS | — |" in text
    links = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert len(links) == 2 + 2 + 2
    for link in links:
        path = reconstruction.folder / link
        assert path.parent in (reconstruction.pictures, reconstruction.pictures / "swatches")
        Image.open(path).load()
    left_over = [path.name for path in reconstruction.folder.rglob("*.part")]
    assert left_over == []


def with_meshes():
    mesh = {
        "vertices": 10_000, "faces": 19_998, "watertight": True, "manifold": True, "chamfer": 0.00251,
        "precision": 0.9, "recall": 0.8, "f1": 0.847, "f1_005": 0.61, "f1_all": 0.7, "texture_psnr": 26.34,
        "texture_coverage": 0.995, "components": 1, "self_intersections": 0, "unobserved": 0.125,
    }  # fmt: skip
    leaky = {**mesh, "watertight": False, "manifold": False, "f1": math.nan, "texture_psnr": 20.0, "faces": 500}
    return {
        "objects": [
            {"id": 1, "name": "mug", "mesh": mesh},
            {"id": 2, "name": "ring", "mesh": leaky},
            {"id": 3, "name": "po|ster", "mesh": {"why": "one view shows it"}},
            {"id": 4, "name": "not meshed"},
        ],
        "meshes": [{"name": "whole scene", "objects": None, **mesh, "faces": 20_000}],
    }


def test_report_md_lists_meshes_and_reasons_for_missing_ones(reconstruction):
    sheet = Image.new("RGB", (300, 200), (250, 250, 250))
    returned = write_report(reconstruction, Report(**with_meshes()), mesh_sheet=sheet).as_dict()
    report = strictly(reconstruction.report_json.read_text(encoding="utf-8"))
    assert report == returned
    assert report["objects"][0]["mesh"]["f1_005"] == 0.61 and report["objects"][1]["mesh"]["f1"] is None
    assert report["objects"][2]["mesh"]["why"] == "one view shows it" and report["objects"][2]["mesh"]["faces"] is None
    assert report["meshes"][0]["faces"] == 20_000
    text = reconstruction.report_md.read_text(encoding="utf-8")
    section = text[text.index("## Meshes") :]
    assert "2 of 4 objects have a mesh; 1 watertight; 1 manifold; median F1 at 0.02 **0.847**" in section
    assert "median texture PSNR **23.2 dB**, lowest 20.0 dB (ring)" in section
    rows = {line.split(" | ")[0].strip("| "): line for line in section.splitlines() if line.startswith("|")}
    for value in ("19,998", "0.00251", "0.847", "0.610", "0.700", "26.3 dB", "99.5%", "12.5%", "yes"):
        assert f" {value} |" in rows["mug"], value
    assert rows["ring"].count("**no**") == 2 and " — |" in rows["ring"]
    assert "one view shows it" in rows[r"po\|ster"] and "20,000" in rows["whole scene"]
    assert "not meshed" not in section
    assert "![Each mesh: surface, wireframe and texture](pictures/meshes.png)" in section
    assert (np.asarray(Image.open(reconstruction.pictures / "meshes.png")) == np.asarray(sheet)).all()
    write_report(reconstruction, Report(**a_report()))
    assert not (reconstruction.pictures / "meshes.png").exists(), "the image of removed meshes is deleted"


def test_mesh_table_without_truth_omits_columns(reconstruction):
    report = with_meshes()
    for entry in (report["objects"][0]["mesh"], report["objects"][1]["mesh"], report["meshes"][0]):
        for name in ("chamfer", "precision", "recall", "f1", "f1_005", "f1_all"):
            entry[name] = None
    write_report(reconstruction, Report(**report))
    section = reconstruction.report_md.read_text(encoding="utf-8").split("## Meshes")[1]
    assert "F1" not in section and "Chamfer" not in section and "Texture" in section


def test_tables_have_words_and_units_instead_of_keys(reconstruction):
    report = Report(
        model={"psnr_of_export": 132.53, "trained_seconds": 177.0, "expected_psnr": [28.04, 37.8], "bytes": 13_400_000},
        settings=Settings().as_dict(),
        machine={"memory_gb": 25.3, "numpy": "2.4.6"},
    )
    write_report(reconstruction, report)
    text = reconstruction.report_md.read_text(encoding="utf-8")
    for row in (
        "PSNR of splats.ply against the model, dB | 132.53 |", "Time of all training | 2 min 57 s |",
        "Expected PSNR, colors corrected, dB | 28.0 to 37.8 |", "Size of splats.ply | 13.4 MB |",
        "`--semantic-weight` | 0.1 |", "Memory, GB | 25.3 |", "numpy | 2.4.6 |",
    ):  # fmt: skip
        assert f"| {row}" in text, row
    assert "\\_" not in text, "a raw key"


def test_names_are_escaped_in_tables(reconstruction):
    write_report(reconstruction, Report(**a_report()))
    lines = reconstruction.report_md.read_text(encoding="utf-8").splitlines()
    row = next(line for line in lines if "tea" in line and line.startswith("|"))
    assert r"tea\|pot" in row
    assert len(re.findall(r"(?<!\\)\|", row)) == 6


def test_swatches_have_object_colors(reconstruction):
    write_report(reconstruction, Report(**a_report()), colors={2: (1, 2, 3)})
    swatches = reconstruction.pictures / "swatches"
    assert Image.open(swatches / "2.png").getpixel((4, 4)) == (1, 2, 3)
    assert Image.open(swatches / "70000.png").getpixel((4, 4)) == object_colors([70_000])[70_000]


def test_only_worst_of_many_objects_are_listed(reconstruction):
    objects = [{"id": i, "name": f"thing {i}", "iou": i / 1000} for i in range(1, 501)]
    report = write_report(reconstruction, Report(objects=objects))
    text = reconstruction.report_md.read_text(encoding="utf-8")
    assert len(report.objects) == 500
    assert "the other 460 are in `report.json`" in text
    assert "thing 40 " in text and "thing 41 " not in text
    assert len(list((reconstruction.pictures / "swatches").iterdir())) == 40


def test_curve_plot_has_one_panel_per_measure():
    curve = complete(Report(**a_report())).curve
    both = plot_curve(curve)
    one = plot_curve([{**point, "miou": None} for point in curve])
    assert both is not None and one is not None
    assert both.width > 1.8 * one.width
    for color in ((0x3B, 0x7D, 0xD8), (0xD9, 0x73, 0x1A)):
        assert (np.asarray(both) == color).all(-1).sum() > 100, color
    assert plot_curve([]) is None
    assert plot_curve([{"seconds": 1.0, "psnr": None, "miou": None}]) is None


def test_object_plot_bars_are_proportional_to_iou():
    objects = [
        {"id": 1, "name": "a", "iou": 0.8},
        {"id": 2, "name": "$b$", "iou": 0.2},
        {"id": 3, "name": "c", "iou": None},
    ]
    image = np.asarray(plot_objects(objects, {1: (255, 0, 0), 2: (0, 0, 255), 3: (0, 255, 0)}))
    red, blue, green = (
        (image == np.array(color)).all(-1).any(0).sum() for color in ((255, 0, 0), (0, 0, 255), (0, 255, 0))
    )
    assert red / blue == pytest.approx(4.0, rel=0.05)
    assert green == 0
    assert plot_objects([objects[2]], {}) is None


def test_durations_are_formatted():
    assert [duration(s) for s in (0.04, 9.9, 9.96, 59.4, 59.6, 150, 3599.6, 3900)] == [
        "0.0 s", "9.9 s", "10 s", "59 s", "1 min 00 s", "2 min 30 s", "1 h 00 min", "1 h 05 min",
    ]  # fmt: skip


def test_object_colors_depend_only_on_id():
    few, many = object_colors([0, 5, 2**32 - 1]), object_colors(range(2000))
    assert few[0] == UNLABELED and few[5] == many[5]
    assert all(isinstance(channel, int) for color in few.values() for channel in color)
    first = np.array([many[i] for i in range(13)], int)
    apart = np.abs(first[:, None] - first[None]).sum(-1) + 999 * np.eye(13, dtype=int)
    assert apart.min() > 60
    later = np.array([many[i] for i in range(30, 2000)], int)
    assert (np.abs(np.diff(later, axis=0)).sum(1) > 30).mean() > 0.99
    assert len({tuple(color) for color in later.tolist()}) > 1950
    assert colors_of([]).shape == (0, 3)


def test_to_linear_decodes_srgb():
    assert to_linear((0, 255, 188)) == pytest.approx((0.0, 1.0, 0.5029), abs=1e-4)


def test_id_images_use_given_colors_or_palette():
    ids = np.array([[0, 7], [2**32 - 1, 7]])
    image = id_image(ids, {7: (9, 8, 7)})
    palette = object_colors([0, 2**32 - 1])
    assert image.dtype == np.uint8
    assert image.tolist() == [[list(palette[0]), [9, 8, 7]], [list(palette[2**32 - 1]), [9, 8, 7]]]


def panels(sheet):
    """Return the colors of a sheet and their numbers of pixels."""
    colors, counts = np.unique(np.asarray(sheet).reshape(-1, 3), axis=0, return_counts=True)
    return {tuple(color): int(count) for color, count in zip(colors.tolist(), counts)}


def test_comparison_shows_four_unchanged_images():
    truth = np.full((60, 80, 3), (200, 10, 10), np.uint8)
    render = np.full((60, 80, 3), (0.0, 1.0, 0.0), np.float32)
    ids, true_ids = np.full((60, 80), 3), np.full((60, 80), 70_000)
    sheet = comparison(truth, render, true_ids, ids, {3: (1, 2, 250), 70_000: (250, 2, 250)}, {3: "cup"}, "A title")
    found = panels(sheet)
    for color in ((200, 10, 10), (0, 255, 0), (1, 2, 250), (250, 2, 250)):
        assert found.get(color, 0) >= 60 * 80, color
    without = comparison(truth, render, None, ids)
    assert without.width < sheet.width
    assert panels(without).get((250, 2, 250), 0) == 0


def test_comparison_limits_size_of_images_and_legend():
    rng = np.random.default_rng(0)
    ids = rng.integers(1, 400, (30, 40)).repeat(40, 0).repeat(40, 1)
    image = rng.random((1200, 1600, 3))
    image[0, 0] = np.nan
    sheet = comparison(image, image, ids, ids, None, {i: f"a rather long name of object {i}" for i in range(400)})
    assert sheet.width <= 2000 and sheet.height < 700


def test_contact_sheet_shows_all_images():
    images = [np.full((30, 40, 3), 40 * i, np.uint8) for i in range(1, 6)]
    found = panels(contact_sheet([*images[:4], Image.fromarray(images[4])], list("abcde"), columns=3))
    for i in range(1, 6):
        assert found.get((40 * i,) * 3, 0) >= 30 * 40
    with pytest.raises(ValueError, match="at least one"):
        contact_sheet([], [])


def test_mask_sheet_counts_photos_and_names_its_colors(tmp_path):
    sheet = MaskSheet(30)
    for number in range(30):
        ids = np.zeros((60, 80), np.int64)
        ids[:20] = 7 if number < 20 else 0
        ids[40:] = 9 if number < 10 else 0
        sheet.add(f"{number}.png", ids, lambda: np.zeros((120, 160, 3), np.uint8))
    assert sheet.summary() == "2 objects in 20 of 30 photos" and sheet.photos_of == {7: 20, 9: 10}
    sheet.save(tmp_path / "named.jpg", {7: "mug"})
    sheet.save(tmp_path / "other.jpg", {7: "a longer name"})
    named, other = (np.asarray(Image.open(tmp_path / name), np.int64) for name in ("named.jpg", "other.jpg"))
    changed = np.flatnonzero((abs(named - other) > 30).any((1, 2)))
    assert len(changed) and changed.min() > 0.8 * len(named), "the legend alone has the names"


def test_saved_images_are_small(tmp_path):
    flat = save_image(Image.new("RGB", (900, 700), (1, 2, 3)), tmp_path / "flat.png")
    assert flat.suffix == ".png" and Image.open(flat).getpixel((0, 0)) == (1, 2, 3)
    y, x = np.mgrid[:600, :1800]
    rng = np.random.default_rng(0)
    photo = 120 + 60 * np.sin(x / 40)[..., None] + 50 * np.cos(y / 30)[..., None] + rng.normal(0, 4, (600, 1800, 3))
    saved = save_image(Image.fromarray(np.clip(photo, 0, 255).astype(np.uint8)), tmp_path / "photo.png")
    assert saved.suffix == ".jpg" and saved.stat().st_size < 300_000
    assert sorted(path.name for path in tmp_path.iterdir()) == ["flat.png", "photo.jpg"]


def test_long_names_are_shortened_in_images():
    font = load_font(12)
    assert shorten("mug", font, 100) == "mug"
    for name in ("a" * 2_000_000, "\n" * 500, "mug " * 50):
        shown = shorten(name, font, 100)
        assert shown.endswith("...") and font.getlength(shown) <= 100
