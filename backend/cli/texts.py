"""Help texts of the commands."""

INTRODUCTION = """\
Turn photos into labeled splats and meshes. A capture is a folder with images/, the
COLMAP model of their cameras in sparse/0 (or transforms.json, or the cameras that
Metashape, RealityScan or Bundler exported) and, for objects, an object ID mask of each
image in masks/. The result is written to a reconstruction folder.

  python -m backend sfm      photos --out garden         make a capture of photos
  python -m backend check    garden                      check the capture
  python -m backend plan     garden                      show what training would do
  python -m backend train    garden --out garden-splats  train the splats (5 minutes)
  python -m backend mesh     garden-splats               extract a mesh of each object
  python -m backend evaluate garden-splats               measure their quality
  python -m backend report   garden-splats               write garden-splats/report.md
  python -m backend edit     garden-splats --remove mug  edit objects
  python -m backend export   garden-splats --out all.ply export for other programs
"""

ENDING = """\
`python -m backend COMMAND --help` lists the options of a command. Ctrl+C stops at any
time; run the same command again to resume. Exit codes: 0 done, 2 the input cannot be
used (the message says why), 130 stopped, 1 any other error.
"""

SFM = """\
Make a capture of photos or a video alone: compute by COLMAP where they were taken, and
points of the scene. Photos are copied to CAPTURE/images, unless PHOTOS is that folder;
HEIC becomes JPEG. Of a video, sharp frames are taken, evenly in how far the picture
moves. The cameras are written to CAPTURE/sparse/0, and what was found to
CAPTURE/sfm/sfm.json. Photos that do not fit are named with the reason. If PHOTOS has a
folder images/, the photos in it are taken; if it has masks/, that is copied, too.
Cameras that are fixed to each other, with a folder each and the same names for the
photos of a moment, are recognized. After a stop, the same command goes on.

With --matcher, networks match the photos, for those that differ too much in light or
place for SIFT. FOLDER is a checkpoint of the package transformers, config.json and
weights, of LightGlue, which matches features that SuperPoint finds, or EfficientLoFTR,
which needs no features. Nothing is downloaded. Each pair of photos takes seconds.
"""

MASKS = """\
Make masks/ and labels.json of a capture of masks that another program wrote, or of the
segments that a model finds. MASKS is
  a file of COCO (instances or panoptic), CVAT (for images or videos) or Label Studio;
  a folder with a file for each photo, named like it: PNG or NumPy with IDs, black and
  white PNG or JPEG, EXR with Cryptomatte or object indices, or JSON with run lengths;
  a folder of black and white images for each object, or for each photo;
  a folder with a checkpoint of SAM, SAM 2.1 or EdgeTAM for the package transformers
  (config.json and weights), by which every photo is segmented. Nothing is downloaded.
  Results are kept in masks-segments/, so that the same command goes on after a stop.
Segments that are numbered in each photo on their own, as by Segment Anything, get one
ID for each object: segments that show the same points are the same object. Segments
that show several objects are divided. masks/masks.jpg shows the result. Masks that are
in masks/ already are kept in masks-given/.

With --text, objects are those that it names, in English, and labels.json has the names.
--detector is a folder with a checkpoint of Grounding DINO, tokenizer included, which
finds them in each photo for the model of MASKS. SAM 3 as MASKS needs no detector.
"""

CHECK = """\
Check a capture and list its contents and problems: cameras, images without a pose,
masks, objects. Nothing is written.
"""

IMPORT = """\
Prepare a capture for display: undistort its images once, and write its cameras to
cameras.json and its points to points.ply. `vote` and `train` do this themselves.
"""

PLAN = """\
Show what training would do with a capture, what it would omit, and why. Nothing is
trained and no image is changed. `plan` takes the options of `train`; --keep and
--leave-out override its decisions. With --out, the votes and omitted objects in DIR
are taken into account, and the plan is written to DIR/plan.json.
"""

VOTE = """\
Assign each 3D point of the capture the object that most masks show at the point.
Writes points.ply, with an object_id per point, and objects.json to the reconstruction
folder. `train` votes itself if no current votes exist.
"""

TRAIN = """\
Train the splats. Writes splats.ply, which splat viewers and Blender read, checkpoints
to resume from, and previews/, which show the progress. If training is stopped, it
keeps the mean of its latest steps. To train longer, run the command again with more
--minutes or --steps. `torchrun --nproc-per-node 4 -m backend train ...` trains with
four processes or GPUs.
"""

SPLIT = """\
Divide a trained model into cells that are trained further one by one, so that each
takes a part of the memory, or by several machines at the same time. Train a coarse
model of the whole capture first. Then run `split`, `train-cell` for each cell in any
order, and `merge`. Writes DIR/cells. Machines that train cells need DIR and the
capture, and write only to the folder of their cell.
"""

TRAIN_CELL = """\
Train one cell of a divided model further. What its photos show around it stays as it
is. It may have as many anchors as the whole model before, unless --max-anchors says
otherwise, and so more detail. After a stop, run the same command again to go on.
"""

MERGE = """\
Join the trained cells of a divided model, and train a little more where they meet.
Replaces the checkpoint and splats.ply of the reconstruction; meshes have to be made
again. After a stop, run the same command again to go on.
"""

PROPOSE = """\
Find the objects of splats without masks: large planes, what stands on them, and splats
with concave borders or gaps around them, such as things on a table, the table and the
walls. Flat things that lie on others, and things that touch smoothly, are not told apart.
If things are in parts, lower --detail; if several are one, raise it. Writes strokes that
mark the objects in three photos each, for `label`; they may be changed before. A picture
beside them shows the objects. Splats that were imported without a capture are looked at
through cameras around them.
"""

LABEL = """\
Separate the objects of splats without masks, by strokes on them in one or more photos.
Gives the splats the IDs of their objects. After a training, it writes masks/, for the
training views, and labels.json to the capture's folder, and trains the objects' borders
for a short time; imported splats stay as they are. Repeat the command with more strokes
to correct the result. FILE is JSON:
  {"objects": {"1": "mug"},
   "strokes": [{"object": 1, "view": "photo.jpg", "points": [[0.42, 0.5], [0.48, 0.5]]}]}
Points are fractions of the undistorted photo's width and height, from its top left
corner. With "area": true, the line encloses an area. Instead of "view", a "camera" may
have "viewmat" (4 x 4, world to camera), "intrinsics" (fx, fy, cx, cy), "width" and
"height". A "part" of 1 or more finds the strokes' part of the object as if it were an
object of its own; Blender merges marked objects so. Object 0 is what belongs to no
object, like all that is far from the strokes, unless the file has "everything": true.

With --segmenter, each stroke stands for all that SAM, SAM 2.1 or EdgeTAM segments by it,
so that a few strokes tell more; those with "exact": true, as `propose` writes them, are
left as they are. FOLDER is a checkpoint of the package transformers: config.json and
weights. Nothing is downloaded.
"""

CLEAN_LABELS = """\
Correct the objects of splats by the masks of all photos together. Where photos give the
same points different IDs, regions that show the same points get one ID. Regions that the
other photos contradict get the IDs that the splats show, and so do photos without masks;
the rest is kept. Then the splats get their objects anew, and after a training, their
borders are trained for a short time. masks/ is replaced, repair.json in it says what was
changed, and the given masks are kept in masks-given/. Masks may also be made after the
training, such as by `masks`.
"""

POINT = """\
Answer strokes with the object of each splat, or before a training of each point, for
programs such as Blender. Each line of standard input is a JSON object as for `label`,
with a number `request` for the answer. With "propose": true, the answer has strokes on
proposed objects, as `propose` finds with the number `detail`. --segmenter is as for
`label`.
"""

RENDER = """\
Render the splats from the capture's cameras to DIR/renders, with the images' names.
"""

EVALUATE = """\
Compare renderings with the photos held out of training (every 8th, or those in the
capture's test.txt). PSNR and SSIM measure the images; mIoU, mBIoU, Dice and accuracy
measure how well the objects agree with the masks. mIoU (all) also counts objects
rendered on unlabeled pixels as errors, and is shown where these pixels are background;
the others ignore them. Meshes are measured too: whether they are closed, how their
textures look in those photos and, if CAPTURE/truth contains the true surfaces, how far
they are from these. `report` shows the figures.
"""

MESH = """\
Extract a textured mesh of each object: closed, in the capture's coordinates, as PLY
with a PNG texture in DIR/meshes. After a stop, run the same command again for the
remaining meshes. `evaluate` then measures the meshes too.
"""

FILM = """\
Render film frames of the splats, with the edits in DIR/objects.json, from a shot file:
multilayer EXR with color (linear, premultiplied), depth, object IDs and Cryptomatte.
Blender's Render panel writes shot files; their format is described in
backend/shared/reconstruction/shot.py. Existing frames are skipped, so several machines
can share a folder, each with its own --frames.
"""

REPORT = """\
Write report.md, with images, plots and a list of what was omitted, and report.json,
the same for programs. Run `evaluate` first, so that the report includes quality.
"""

EDIT = """\
Remove, recolor, move or duplicate objects; `export`, `film` and Blender show the
result. Edits are stored in objects.json, and the trained splats stay unchanged, so
that every edit can be undone. Without options, list the edits. OBJECT is a name, part
of a name, or an ID; separate several KEY=VALUE with commas. Lengths are in the
capture's units. x, y and z are Blender's axes, Z up; the rotations rx, ry and rz, in
degrees, and the scale are about the object's center. A new color or transform replaces
the earlier one.
"""

EXPORT = """\
Export the splats, with all edits, for other programs: as PLY (exact, with object_id),
SPZ (a fifth of the size), .splat (one color per splat), or glTF (.glb) or USD (.usdc)
with each object apart.
"""

IMPORT_SPLATS = """\
Make a reconstruction from splats that another program trained: PLY, SPZ, .splat, glTF
(.glb) or USD. Their objects are taken from object_id in the PLY, from the nodes of glTF
and USD or, with --capture, from a vote by that capture's masks; the splats must be in
its coordinates.
"""

DOCTOR = """\
Show versions and devices, and test everything on a tiny scene. The first run compiles
the kernels, which takes about a minute, so that later commands start at once.
"""
