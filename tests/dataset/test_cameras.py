import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from damaged import edit
from fake_dataset import COLUMNS, fake_episode, write_images, writer

from astra_data.core.errors import BadInputError, CorruptDatasetError
from astra_data.dataset.cameras import ClipWriter, clip_fault, decoded
from astra_data.dataset.columns import Clip
from astra_data.dataset.doctor.check import check
from astra_data.dataset.doctor.repair import repair
from astra_data.dataset.edit import filter_episodes, merge, resample, subset, trim
from astra_data.dataset.format import INFO_PATH
from astra_data.dataset.frames import Frames
from astra_data.dataset.inspection import inspect_dataset
from astra_data.dataset.reader import Dataset
from astra_data.dataset.versions import next_version
from astra_data.io.hub.card import Notes, render_card
from astra_data.io.hub.stores import dataset_files

av = pytest.importorskip("av")
FRONT, TOP, FPS = "observation.images.front", "observation.images.top", 20
LENGTHS = {3: 14, 8: 9, 5: 30}
"""Steps of the episodes by their uids."""
FEATURES: dict[str, Any] = {
    FRONT: {"dtype": "video", "shape": [64, 64, 3], "names": ["height", "width", "channels"]},
    TOP: {"dtype": "image", "shape": [4, 4, 3], "names": ["height", "width", "channels"]},
}
STATISTICS = {key: [[[0.5]], [[0.25]], [[0.125]]] for key in ("min", "max", "mean", "std")}


def film(path: Path, frames: int, codec: str = "libx264", **options: str) -> Path:
    """Write a video of which every frame is another."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream(
            codec, rate=FPS, options={"g": "2", "sc_threshold": "0", "x265-params": "scenecut=0", **options}
        )
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for number in range(frames):
            picture = np.full((64, 64, 3), 40 + number, np.uint8)
            picture[number % 64, :, 1] = 255
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        file.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Three episodes with two cameras, a file each; the first frame of what they were made from belongs to none."""
    return recorded(tmp_path_factory.mktemp("cameras"), first=1)


def recorded(folder: Path, first: int, **options: str) -> Dataset:
    patch = pytest.MonkeyPatch()
    patch.setattr("astra_data.dataset.format.FILE_SIZE_LIMIT", 100)
    patch.setattr("astra_data.dataset.format.VIDEO_FILE_SIZE_MB", 0)
    total = first + sum(LENGTHS.values())
    stills = (np.full((4, 4, 3), number, np.uint8) for number in range(total))
    video, images = film(folder / "video.mp4", total, **options), write_images(folder / "images.parquet", TOP, stills)
    with writer(folder / "set", cameras=FEATURES) as opened:
        for uid, steps in LENGTHS.items():
            statistics = STATISTICS | {"count": [steps]}
            clips = {
                FRONT: Clip(video, FRONT, first / FPS, 1 / FPS, steps, statistics=statistics),
                TOP: Clip(images, TOP, first, 1, steps),
            }
            opened.add(replace(fake_episode(uid, steps), cameras=clips))
            first += steps
        patch.undo()
    assert len([*(folder / "set").glob("data/*/*.parquet")]) == len([*(folder / "set").rglob("*.mp4")]) == 3
    return Dataset.open(folder / "set")


def pictures(dataset: Dataset, uid: int) -> tuple[Any, Any]:
    index = dataset.uids.tolist().index(uid)
    return dataset.pictures(FRONT, index), dataset.pictures(TOP, index)


def assert_shows(root: Path, source: Dataset, expected: dict[int, tuple[int, slice]]) -> None:
    """Check the pictures of each uid: those of a uid of `source`, of these steps."""
    found = Dataset.open(root)
    assert check(root).faults == [] and sorted(found.uids.tolist()) == sorted(expected)
    for uid, (of, steps) in expected.items():
        for one, before in zip(pictures(found, uid), pictures(source, of), strict=True):
            np.testing.assert_array_equal(one, before[steps])


ALL = {uid: (uid, slice(None)) for uid in LENGTHS}


def test_a_written_camera_shows_the_frames_that_it_was_given(source: Dataset) -> None:
    first = 1
    for uid, steps in LENGTHS.items():
        front, top = pictures(source, uid)
        assert front.shape == (steps, 64, 64, 3) and top.shape == (steps, 4, 4, 3)
        assert top[:, 0, 0, 0].tolist() == list(range(first, first + steps))
        assert front[:, :, :, 1].mean(axis=2).argmax(axis=1).tolist() == list(range(first, first + steps))  # the line
        first += steps
    assert source.statistics()[FRONT]["mean"] == [[[0.5]], [[0.25]], [[0.125]]]
    assert source.statistics()[FRONT]["count"] == [sum(LENGTHS.values())]
    assert FRONT not in source.features and FRONT in repr(source)


def test_edits_keep_the_pictures_of_the_steps_that_are_left(source: Dataset, tmp_path: Path) -> None:
    half = subset(source, episodes=2, out=tmp_path / "subset")
    assert_shows(half, source, {uid: ALL[uid] for uid in Dataset.open(half).uids.tolist()})
    left = filter_episodes(source, without=[8], out=tmp_path / "filter")
    assert_shows(left, source, {uid: ALL[uid] for uid in (3, 5)})
    ends = slice(3, -2)
    trimmed = trim(source, start_s=0.15, end_s=0.1, out=tmp_path / "trim")
    assert_shows(trimmed, source, {uid: (uid, ends) for uid in LENGTHS})
    again = trim(Dataset.open(trimmed), start_s=0.05, out=tmp_path / "again")
    assert_shows(again, source, {uid: (uid, slice(4, -2)) for uid in LENGTHS})
    merged = merge([source, Dataset.open(half)], new_uids=True, out=tmp_path / "merge")
    copies = dict(zip(Dataset.open(merged).uids.tolist(), [*LENGTHS, *Dataset.open(half).uids.tolist()], strict=True))
    assert_shows(merged, source, {uid: ALL[of] for uid, of in copies.items()})
    slow = {uid: (uid, slice(0, None, 4)) for uid in LENGTHS}
    assert_shows(resample(source, 5, out=tmp_path / "slow"), source, slow)
    repair(source.root, out=tmp_path / "repaired")
    assert_shows(tmp_path / "repaired", source, ALL)


def test_lerobots_loader_shows_the_same_pictures(lerobot: SimpleNamespace, source: Dataset, tmp_path: Path) -> None:
    for root in (source.root, trim(source, start_s=0.15, out=tmp_path / "trim")):
        ours = Dataset.open(root)
        loaded = lerobot.dataset.LeRobotDataset("a/b", root=root, video_backend="pyav")
        for episode, start in enumerate(ours.starts.tolist()):
            items = [loaded[start + step] for step in range(int(ours.lengths[episode]))]
            for name in FEATURES:
                theirs = np.stack([item[name].numpy() for item in items]).transpose(0, 2, 3, 1)
                np.testing.assert_allclose(theirs * 255, ours.pictures(name, episode), atol=1e-3)


@pytest.mark.parametrize(("codec", "group"), [("libx264", "12"), ("libx264", "250"), ("libx265", "250")])
def test_frames_are_cut_within_groups_and_encoded_again_in_long_ones(codec: str, group: str, tmp_path: Path) -> None:
    clip = Clip(film(tmp_path / "film.mp4", 90, codec, g=group), FRONT, 31 / FPS, 1 / FPS, 39)
    written, path = ClipWriter(tmp_path, FRONT, FPS), tmp_path / f"videos/{FRONT}/chunk-000/file-000.mp4"
    spans = [written.add(clip), written.add(clip.part(5, 25))]
    written.close()
    assert [(span.file, round((span.to_s - span.from_s) * FPS)) for span in spans] == [(0, 39), (0, 20)]
    pieces = zip(spans, (39, 20), strict=True)
    copies = [decoded(Clip(path, FRONT, at.from_s, 1 / FPS, count)) for at, count in pieces]
    with av.open(str(path)) as file, av.open(str(clip.path)) as source:
        # lerobot's merge joins files with one time base.
        assert group == "250" or file.streams.video[0].time_base == source.streams.video[0].time_base
        begun = (one for one in file.demux(video=0) if one.pts is not None and one.is_keyframe)
        keys = [float(one.pts * one.time_base) for one in begun]
    for found, before in zip(copies, (decoded(clip), decoded(clip)[5:25]), strict=True):
        if group == "12":
            np.testing.assert_array_equal(found, before)
        assert np.abs(found.astype(int) - before).mean() < 2
    assert spans[0].from_s == pytest.approx(0.0 if group == "250" else 7 / FPS)  # in a group of 12
    assert any(spans[1].from_s == pytest.approx(key) for key in keys)


@pytest.mark.parametrize(
    ("folder", "camera", "told"),
    [
        ("videos", FRONT, ("{0} was altered after it was written", "")),
        ("data", TOP, ("{0.parent.name}/{0.name} cannot be read", " (could not verify page integrity")),
    ],
)
def test_altered_pictures_are_refused_and_cost_their_episode_alone(
    source: Dataset, tmp_path: Path, folder: str, camera: str, told: tuple[str, str]
) -> None:
    root = shutil.copytree(source.root, tmp_path / "damaged")
    file = min(path for path in (root / folder).rglob("*") if path.is_file())
    content = bytearray(file.read_bytes())
    pictures = [found.end() for found in re.finditer(b"IDAT", content)]  # also in statistics, before and after the rows
    content[pictures[len(pictures) // 2] if camera == TOP else len(content) // 2] ^= 255
    file.write_bytes(content)
    [fault], [of_episode], opened = Dataset.open(root).verify(), check(root).faults, Dataset.open(root)
    assert fault.split(" (could")[0] == told[0].format(file) and fault.startswith(told[0].format(file) + told[1])
    assert of_episode == f"{camera} in episode 0: {fault}"
    with pytest.raises(CorruptDatasetError, match=re.escape(fault)):
        opened.require_whole()
    advice = ": `astra-data repair DATASET --out FOLDER` keeps the other episodes"
    with pytest.raises(CorruptDatasetError, match=re.escape(fault + advice)):
        subset(opened, percent=100, out=tmp_path / "all")
    assert not (tmp_path / "all").exists()
    assert f"left out the episode of uid 3: {fault}" in repair(root, out=tmp_path / "repaired").notes
    assert_shows(tmp_path / "repaired", source, {uid: ALL[uid] for uid in (8, 5)})


def test_videos_encoded_again_are_kept_where_the_original_is_named(source: Dataset, tmp_path: Path) -> None:
    root = shutil.copytree(source.root, tmp_path / "edited")
    edit(INFO_PATH, robot_type="cart")(root)
    first, _, third = (film(video, 60) for video in sorted((root / "videos").rglob("*.mp4")))
    with pytest.raises(CorruptDatasetError, match=r"info\.json was altered.* with `--like ORIGINAL` if LeRobot"):
        Dataset.open(root)
    alone = "\n".join(repair(root, out=tmp_path / "alone").notes)
    assert f"if LeRobot's tools encoded {FRONT} again, --like" in alone and "fps may be wrong" not in alone
    film(first, 5)  # too few frames
    third.write_bytes((content := third.read_bytes())[:1000] + bytes(4000) + content[5000:])
    notes = repair(root, like=source, out=tmp_path / "joined").notes
    assert notes[0] == f"{FRONT} of 1 episodes was encoded again: its pictures are not those first written"
    assert [uid for uid in LENGTHS if f"left out the episode of uid {uid}: {root}" in "".join(notes)] == [3, 5]
    joined = Dataset.open(tmp_path / "joined")
    assert check(joined.root).faults == [] and joined.uids.tolist() == [8]
    assert joined.pictures(FRONT, 0).shape == (9, 64, 64, 3)
    np.testing.assert_array_equal(joined.pictures(TOP, 0), source.pictures(TOP, 1))
    assert joined.description["parents"] == [source.identity]


def test_without_its_videos_a_camera_is_left_out_and_the_rest_recovered(source: Dataset, tmp_path: Path) -> None:
    root = shutil.copytree(source.root, tmp_path / "damaged")
    shutil.rmtree(root / "videos")
    with pytest.raises(CorruptDatasetError, match=f"{FRONT}: videos/{FRONT}/chunk-000/file-000.mp4, .* missing"):
        Dataset.open(root)
    assert any(f"{FRONT} is left out: videos/" in note for note in repair(root, out=tmp_path / "repaired").notes)
    whole = Dataset.open(tmp_path / "repaired")
    assert list(whole.cameras) == [TOP] and len(whole) == len(LENGTHS)


def test_a_picture_that_cannot_be_decoded_is_told(tmp_path: Path) -> None:
    table = pq.read_table(write_images(tmp_path / "images.parquet", TOP, [np.zeros((4, 4, 3), np.uint8)] * 4))
    rows = table[TOP].to_pylist()
    rows[1]["bytes"], rows[3]["bytes"] = b"no picture", None
    pq.write_table(pa.table({TOP: pa.array(rows, table.schema[0].type)}), tmp_path / "damaged.parquet")
    video = film(tmp_path / "film.mp4", 20)
    content = video.read_bytes()
    begin, end = content.index(b"mdat") + 1000, content.index(b"moov") - 4
    video.write_bytes(content[:begin] + bytes(end - begin) + content[end:])
    for clip in (Clip(tmp_path / "damaged.parquet", TOP, 0, 1, 2), Clip(video, FRONT, 0.0, 1 / FPS, 20)):
        with pytest.raises(CorruptDatasetError, match=f"{clip.path}: a picture of {clip.camera} cannot be decoded"):
            decoded(clip)
    assert "has 1 images of" in str(clip_fault(Clip(tmp_path / "damaged.parquet", TOP, 2, 1, 2)))


@pytest.mark.parametrize(
    "fault", ["missing", "expected 3", "1.950 s for 14 frames", "inside the folder", "lengths or first rows"]
)
def test_a_recording_whose_camera_cannot_be_found_opens_without_it(
    source: Dataset, tmp_path: Path, caplog: pytest.LogCaptureFixture, fault: str
) -> None:
    root = shutil.copytree(source.root, tmp_path / "recording", ignore=shutil.ignore_patterns("astra"))
    [path] = (root / "meta/episodes").rglob("*.parquet")
    rows = pq.read_table(path)
    if fault == "missing":
        shutil.rmtree(root / "videos")
    elif fault == "inside the folder":
        info = (root / "meta/info.json").read_text()
        (root / "meta/info.json").write_text(info.replace('"videos/', '"../videos/'))
    elif fault == "expected 3":
        pq.write_table(rows[:2], path)
    else:
        name = "dataset_from_index" if "rows" in fault else f"videos/{FRONT}/to_timestamp"
        changed = pa.array([2, *rows[name].to_pylist()[1:]], rows[name].type)
        pq.write_table(rows.set_column(rows.schema.get_field_index(name), name, changed), path)
    found = Dataset.open(root)
    assert list(found.cameras) == ([] if fault in ("expected 3", "lengths or first rows") else [TOP])
    assert len(found) == len(LENGTHS)
    assert re.search(f"{FRONT} is left out: .*{fault}", caplog.text)


@pytest.mark.parametrize("known", [0, 1, 2])
def test_repair_finds_pictures_that_metadata_lack_by_their_rows(tmp_path: Path, known: int) -> None:
    """A recorder that is killed has written some rows of meta/episodes, or none."""
    source = recorded(tmp_path, first=0, g="1")
    root = shutil.copytree(source.root, tmp_path / "killed", ignore=shutil.ignore_patterns("astra"))
    [path] = (root / "meta/episodes").rglob("*.parquet")
    pq.write_table(pq.read_table(path)[:known], path)
    notes = repair(root, out=tmp_path / "repaired").notes
    assert any(f"{FRONT}: its places in meta/episodes cannot be read ({known} episodes" in note for note in notes)
    assert_shows(tmp_path / "repaired", source, {uid: (uid, slice(-1)) for uid in LENGTHS})  # without next states
    # Images are in the files that have no footer yet, which are read for their numbers alone.
    for data in (root / "data").rglob("*.parquet"):
        data.write_bytes(data.read_bytes()[:-8])
    repair(root, out=tmp_path / "numbers")
    numbers = Dataset.open(tmp_path / "numbers")
    assert list(numbers.cameras) == [FRONT]
    np.testing.assert_array_equal(numbers.pictures(FRONT, 2), source.pictures(FRONT, 2)[:-1])
    # Where a video is gone, whose rows the others' frames are of is not known.
    min((root / "videos").rglob("*.mp4")).unlink()
    notes = repair(root, out=tmp_path / "again").notes
    again = Dataset.open(tmp_path / "again")
    assert list(again.cameras) == ([FRONT] if known == 2 else [])
    assert again.uids.tolist() == ([8] if known == 2 else [*LENGTHS])
    assert ("left out the episode of uid 5: its pictures of" in "".join(notes)) == (known == 2)


def test_a_version_may_be_without_cameras(source: Dataset, tmp_path: Path) -> None:
    with next_version(source, "episodes", cameras=False, stage="augment", config={}, out=tmp_path / "out") as opened:
        opened.add(next(source.episodes()))
    assert not Dataset.open(tmp_path / "out").cameras


def test_cameras_are_shown_and_shared_with_their_dataset(source: Dataset) -> None:
    assert inspect_dataset(source).cameras == {FRONT: [64, 64, 3], TOP: [4, 4, 3]}
    assert f"| `{FRONT}` | video | (64, 64, 3) |" in render_card(source, Notes())
    assert "videos/observation.images.front/chunk-000/file-000.mp4" in dataset_files(source.root)
    with pytest.raises(BadInputError, match=r"has no column .*\.front \(of a camera's pictures `astra-data features`"):
        source.columns([FRONT])


def test_pictures_load_as_frames(source: Dataset) -> None:
    frames = Frames.load(source, ["action"], episodes=[2], cameras=[FRONT])
    np.testing.assert_array_equal(frames.columns[FRONT].numpy(), source.pictures(FRONT, 2))
    assert next(iter(frames.windows(4).batches(2)))[FRONT].shape == (2, 4, 64, 64, 3)


def test_what_does_not_fit_is_refused(source: Dataset, tmp_path: Path) -> None:
    clips = next(source.episodes()).cameras
    few = {**clips, FRONT: clips[FRONT].part(0, 5)}
    for given, expected in (({FRONT: clips[FRONT]}, TOP), (few, "5 pictures for 14 steps")):
        with pytest.raises(BadInputError, match=expected), writer(tmp_path / "out", cameras=FEATURES) as opened:
            opened.add(replace(fake_episode(3, 14), cameras=given))
    with pytest.raises(BadInputError, match="divides 20, got 3"):
        resample(source, 3, out=tmp_path / "out")
    with pytest.raises(BadInputError, match=f"camera 'side'; it has {FRONT}"):
        source.pictures("side", 0)
    with writer(tmp_path / "blind", columns=COLUMNS) as opened:
        opened.add(fake_episode(99, 4))
    with pytest.raises(BadInputError, match=f"camera {FRONT}"):
        merge([source, Dataset.open(tmp_path / "blind")], out=tmp_path / "out")
    beyond = Clip(clips[FRONT].path, FRONT, 2.5, 1 / FPS, 9)
    assert "no frame at" in str(clip_fault(beyond)) and clip_fault(clips[FRONT]) is None
    with writer(tmp_path / "again", cameras=FEATURES) as opened:
        unreadable = {FRONT: beyond, TOP: clips[TOP].part(0, 9)}
        with pytest.raises(CorruptDatasetError, match="no frame at"):
            opened.add(replace(fake_episode(3, 9), cameras=unreadable, metadata={"floor": 1}))
        opened.add(replace(fake_episode(3, 14), cameras=clips, metadata={"floor": "wood"}))
    [whole] = Dataset.open(tmp_path / "again").episodes()
    assert whole.metadata["floor"] == "wood"
    np.testing.assert_array_equal(decoded(whole.cameras[FRONT]), decoded(clips[FRONT]))
    single = Clip(film(tmp_path / "single.mp4", 1), FRONT, 0.0, 1 / FPS, 1)
    assert decoded(single).shape == (1, 64, 64, 3) and clip_fault(replace(single, count=2)) is not None
