"""Cameras: the pictures of episodes in video or parquet files, cut and joined without encoding them again.

A LeRobot dataset has, for each camera, MP4 files of many episodes, or a column of encoded images; an episode is a
span of one of them. What is copied of a video are groups of pictures: packets from one key frame to the next, so
pictures stay as they are to the bit. Where an episode begins or ends within a group, the rest of the group is copied
with it, unless that is longer than `MOST_EXTRA_S`; then its frames are encoded again.
"""

import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from astra_data.core.durable import file_digest
from astra_data.core.errors import BadInputError, CorruptDatasetError, in_short
from astra_data.dataset import format as layout
from astra_data.dataset import plain
from astra_data.dataset.columns import EPISODE_INDEX, INDEX, Clip
from astra_data.dataset.format import read_blocks

MOST_EXTRA_S = 1.0
_ENCODERS = {"av1": "libsvtav1", "h264": "libx264", "hevc": "libx265"}
_DECODERS = {"libdav1d": "av1", "libaom-av1": "av1"}  # what they decode, where it is not their name
_OPTIONS = {"g": "2", "crf": "23"}  # key frames as dense as lerobot's, so that any frame is read fast


class Camera(NamedTuple):
    """LeRobot's feature of a camera, the clips of episodes by their numbers, and why those of others are not known."""

    feature: Mapping[str, Any]
    clips: Mapping[int, Clip]
    fault: str = ""


class Span(NamedTuple):
    """Where a clip was written: the number of the file, and its times there, s."""

    file: int
    from_s: float
    to_s: float


@dataclass(frozen=True)
class _Index:
    """The packets of a video in the order of decoding: presentation times, and which begin a group of pictures."""

    pts: NDArray[np.int64]
    keys: NDArray[np.intp]
    time_base: Fraction
    codec: str
    header: bytes
    shape: tuple[int, int, str]

    @cached_property
    def shown(self) -> NDArray[np.int64]:
        """The presentation times in order."""
        return np.sort(self.pts)

    @cached_property
    def overlaps(self) -> bool:
        """Whether a group has frames that are shown before its key frame: then it cannot be cut there."""
        return bool((np.minimum.reduceat(self.pts, self.keys) < self.pts[self.keys]).any())

    def frames(self, clip: Clip) -> NDArray[np.int64]:
        """Return the presentation times of a clip's frames, (count,)."""
        wanted_s = clip.start + np.arange(clip.count) * clip.step
        wanted = wanted_s / float(self.time_base)
        later = np.searchsorted(self.shown, wanted).clip(max=len(self.pts) - 1)
        earlier = (later - 1).clip(min=0)
        nearest = np.where(wanted - self.shown[earlier] < self.shown[later] - wanted, earlier, later)
        apart_s = np.abs(self.shown[nearest] - wanted) * float(self.time_base)
        if (wrong := apart_s > clip.step / 2 + 1e-9).any():
            time_s = wanted_s[wrong.argmax()]
            raise CorruptDatasetError(f"{clip.path} has no frame at {time_s:.3f} s, expected {clip.count} in a row")
        return np.asarray(self.shown[nearest])

    def groups(self, low: int, high: int) -> tuple[int, int]:
        """Return the packets, first and end, whose groups show the times `low` to `high`."""
        ends = [*self.keys[1:], len(self.pts)]
        first, last = (int(np.searchsorted(self.pts[self.keys], time, side="right")) - 1 for time in (low, high))
        return int(self.keys[first]), int(ends[last])


def _indexed(clip: Clip) -> _Index:
    if not clip.path.is_file():
        raise CorruptDatasetError(f"{clip.path} is missing")
    return _index(clip.path, clip.digest, clip.path.stat().st_mtime_ns)


@lru_cache(maxsize=4096)
def _digest(path: Path, _changed_ns: int) -> str:
    """Return the digest of a video, which many clips ask for, as long as it does not change."""
    return file_digest(path)


@lru_cache(maxsize=8)
def _index(path: Path, digest: str | None, changed_ns: int) -> _Index:
    import av  # noqa: PLC0415 - slow

    if digest and _digest(path, changed_ns) != digest:
        raise CorruptDatasetError(f"{path} was altered after it was written")
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            packets = [packet for packet in container.demux(stream) if packet.pts is not None]
            keys = np.array([number for number, packet in enumerate(packets) if packet.is_keyframe])
            pts = np.array([packet.pts for packet in packets], np.int64)
            context = stream.codec_context
            shape, header = (context.width, context.height, str(context.pix_fmt)), bytes(context.extradata or b"")
            codec = _DECODERS.get(context.name, context.name)
            found = _Index(pts, keys, Fraction(stream.time_base or 1), codec, header, shape)
    except (av.FFmpegError, IndexError, OSError) as error:
        raise CorruptDatasetError(f"{path} cannot be read as a video ({error})") from None
    if not len(keys) or keys[0] != 0:
        raise CorruptDatasetError(f"{path} does not begin with a key frame")
    return found


def read_cameras(root: Path, info: Mapping[str, Any]) -> dict[str, Camera]:
    """Return the cameras of the LeRobot dataset in `root`, with the clips that its metadata tell."""
    cameras, described = dict[str, Camera](), plain.read_object(root / layout.DATASET_PATH)
    digests = {} if isinstance(described, str) else described.get("videos", {})
    features = info["features"] if isinstance(info.get("features"), Mapping) else {}
    for name, feature in features.items():
        if not isinstance(feature, Mapping) or (kind := feature.get("dtype")) not in ("video", "image"):
            continue
        known, clips, fault, rows = _of_video if kind == "video" else _of_images, dict[int, Clip](), "", 0
        try:
            for number, clip in (_of_format_2 if plain.is_format_2(root) else known)(root, info, name):
                digest = digests.get(clip.path.relative_to(root).as_posix())
                clips.setdefault(number, replace(clip, digest=digest))
                rows += 1
            if [*clips] != [*range(info["total_episodes"])] or rows != len(clips):
                raise ValueError(f"{rows} episodes, expected {info['total_episodes']}")
            if gone := sorted({str(clip.path.relative_to(root)) for clip in clips.values() if not clip.path.is_file()}):
                fault = f"{', '.join(gone[:3])}{' and others' * (len(gone) > 3)} missing"
        except (CorruptDatasetError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            fault = f"its places in meta/episodes cannot be read ({error})"
        cameras[name] = Camera(feature, clips, fault)
    return cameras


def _rows(root: Path, names: Sequence[str], camera: str) -> Iterator[tuple[int, list[Any], dict[str, Any]]]:
    """Yield the number of each episode, its values `names`, and its statistics of a camera."""
    stored = {f"stats/{camera}/{key}": key for key in layout.STORED_STATISTICS}
    for block in read_blocks(plain.episodes_files(root), [EPISODE_INDEX, *names, *stored]):
        for row in block.to_pylist():
            known = {key: row[name] for name, key in stored.items() if row.get(name) is not None}
            yield row[EPISODE_INDEX], [row[name] for name in names], known


def _of_video(root: Path, info: Mapping[str, Any], name: str) -> Iterator[tuple[int, Clip]]:
    pattern, wrong = _video_pattern(info, name), ""
    known = ["length", *(f"videos/{name}/{key}" for key in layout.VIDEO_PLACE)]
    for number, (length, chunk, file, from_s, to_s), statistics in _rows(root, known, name):
        if abs((to_s - from_s) * info["fps"] - length) > 1:
            wrong = wrong or f"{to_s - from_s:.3f} s for {length} frames"
            continue
        path = root / pattern.format(chunk_index=chunk, file_index=file)
        yield number, Clip(path, name, from_s, 1 / info["fps"], length, None, statistics)
    if wrong:
        raise ValueError(wrong)


def _video_pattern(info: Mapping[str, Any], name: str) -> str:
    pattern = str(info["video_path"]).replace("{video_key}", name)
    if not plain.is_data_path(pattern):
        raise ValueError(f"expected a video_path inside the folder, got {info['video_path']!r}")
    return pattern


def _of_images(root: Path, info: Mapping[str, Any], name: str) -> Iterator[tuple[int, Clip]]:
    known = "length", "dataset_from_index", "data/chunk_index", "data/file_index"
    firsts: dict[Path, int] = {}
    if not plain.is_data_path(info["data_path"]):
        raise ValueError(f"expected a data_path inside the folder, got {info['data_path']!r}")
    for number, (length, first, chunk, file), statistics in _rows(root, known, name):
        path = root / info["data_path"].format(chunk_index=chunk, file_index=file)
        yield number, Clip(path, name, first - firsts.setdefault(path, first), 1, length, None, statistics)


def _of_format_2(root: Path, info: Mapping[str, Any], name: str) -> Iterator[tuple[int, Clip]]:
    for number, place in sorted(plain.read_places(root, info)[0].items()):
        if info["features"][name]["dtype"] == "image" and place.path:
            yield number, Clip(place.path, name, 0, 1, place.length)
            continue
        chunk = number // int(info.get("chunks_size", layout.CHUNK_SIZE))
        path = root / f"videos/chunk-{chunk:03d}/{name}/episode_{number:06d}.mp4"
        yield number, Clip(path, name, 0, 1 / info["fps"], place.length)


def clips_of_runs(
    root: Path, info: Mapping[str, Any], name: str, runs: Iterable[plain.Run]
) -> Iterator[tuple[int, Clip]]:
    """Yield the number and the clip of each episode of `runs`, by its rows.

    Images are in its rows; videos, one after another, have a frame of each row that LeRobot recorded, or tell nothing.
    """
    is_video, files, counts = info["features"][name]["dtype"] == "video", list[Path](), list[int]()
    if is_video:
        files = sorted(root.glob(re.sub(r"\{[^}]*\}", "*", _video_pattern(info, name))))
        counts = [len(_index(path, None, path.stat().st_mtime_ns).pts) for path in files]
        if sum(counts) != info["total_frames"]:
            return
    ends = np.cumsum(counts)
    for run in runs:
        number, first = int(np.median(run.columns[EPISODE_INDEX])), int(run.columns[INDEX][0])
        if not is_video:
            yield number, Clip(run.path, name, run.row, 1, len(run))
        elif (at := int(np.searchsorted(ends, first, side="right"))) < len(ends) and first + len(run) <= ends[at]:
            frame = first - int(ends[at]) + counts[at]
            yield number, Clip(files[at], name, frame / info["fps"], 1 / info["fps"], len(run))


def clip_fault(clip: Clip) -> str | None:
    """Return what is wrong with the file of a clip, if its pictures are not all there; nothing is decoded."""
    try:
        if clip.path.suffix == ".mp4":
            _indexed(clip).frames(clip)
        else:
            images(clip)
    except CorruptDatasetError as error:
        return str(error)
    return None


def altered_videos(clips: Iterable[Clip]) -> set[Path]:
    """Return the videos of `clips` that are not as they were written."""
    written = {clip.path: clip.digest for clip in clips if clip.digest and clip.path.is_file()}
    return {path for path, digest in written.items() if _digest(path, path.stat().st_mtime_ns) != digest}


def encoded_again(clips: Mapping[int, Clip]) -> Iterator[tuple[int, Clip]]:
    """Yield those of `clips` in altered videos of which every frame can be decoded, without digests."""
    altered = altered_videos(clips.values())
    for number, clip in clips.items():
        anew = replace(clip, digest=None)
        with suppress(CorruptDatasetError):
            if clip.path in altered and sum(True for _ in _decode(anew)):
                yield number, anew


def images(clip: Clip) -> list[dict[str, Any]]:
    """Return the stored images of a clip in a parquet file, its bytes, of which there are some, and path each."""
    rows, footer = np.rint(clip.start + np.arange(clip.count) * clip.step).astype(int), plain.read_footer(clip.path)
    if isinstance(footer, str) or footer[0] <= rows[-1] or clip.camera not in footer[1].names:
        fault = footer if isinstance(footer, str) else f"has no images of {clip.camera} up to row {rows[-1]}"
        raise CorruptDatasetError(f"{clip.path} {fault}")
    wanted = np.zeros(footer[0], bool)
    wanted[rows] = True
    stored = (one for block in read_blocks([clip.path], [clip.camera], wanted) for one in block[0].to_pylist())
    found = [one for one in stored if isinstance(one, dict) and one.get("bytes")]
    if len(found) != clip.count:
        raise CorruptDatasetError(f"{clip.path} has {len(found)} images of {clip.camera}, expected {clip.count}")
    return found


def decoded(clip: Clip) -> NDArray[Any]:
    """Return the pictures of a clip, (T, H, W, 3) uint8; those of a depth camera are (T, H, W) uint16."""
    return np.stack(list(pictures_of(clip)))


def pictures_of(clip: Clip) -> Iterator[NDArray[Any]]:
    """Yield the pictures of a clip one by one, as `decoded` has them."""
    if clip.path.suffix == ".mp4":
        kinds = {"gray10le": "gray16le", "gray12le": "gray16le", "gray16le": "gray16le"}  # of depth cameras
        yield from (frame.to_ndarray(format=kinds.get(frame.format.name, "rgb24")) for frame in _decode(clip))
        return
    from PIL import Image  # noqa: PLC0415 - slow

    for one in images(clip):
        with _decoding(clip):
            picture = np.asarray(Image.open(io.BytesIO(one["bytes"])))
        yield picture


@contextmanager
def _decoding(clip: Clip) -> Iterator[None]:
    """Turn any exception of the library that decodes a clip into a CorruptDatasetError."""
    try:
        yield
    except Exception as error:
        fault = f"a picture of {clip.camera} cannot be decoded ({in_short(error)})"
        raise CorruptDatasetError(f"{clip.path}: {fault}") from error


def _decode(clip: Clip) -> Iterator[Any]:
    import av  # noqa: PLC0415 - slow

    wanted = _indexed(clip).frames(clip)
    left = set(wanted.tolist())
    with _decoding(clip), av.open(str(clip.path)) as container:
        stream = container.streams.video[0]
        container.seek(int(wanted[0]), stream=stream)
        for frame in container.decode(stream):
            if frame.pts in left:
                left.discard(frame.pts)
                yield frame
            if not left:
                return
    raise CorruptDatasetError(f"{clip.path}: {len(left)} of {clip.count} frames cannot be decoded")


class ClipWriter:
    """Writes clips of the camera `name`, one after another, to the MP4 files of the dataset in `root`."""

    def __init__(self, root: Path, name: str, fps: int) -> None:
        self._root, self._name, self._fps = root, name, fps
        self._file, self._time_s, self._bytes = -1, 0.0, 0
        self._output: Any = None
        self._stream: Any = None
        self._kind: object = None

    def add(self, clip: Clip) -> Span:
        """Append a clip, whose step may be longer than that of its file; return where it is."""
        index = _indexed(clip)
        times = index.frames(clip)
        packets = index.groups(int(times[0]), int(times[-1]))
        needed = int(np.searchsorted(index.shown, times[-1]) - np.searchsorted(index.shown, times[0])) + 1
        if index.overlaps or (packets[1] - packets[0] - needed) / self._fps > MOST_EXTRA_S:
            return self._encode(clip, index)
        return self._copy(clip, index, packets, times)

    def _copy(self, clip: Clip, index: _Index, packets: tuple[int, int], times: NDArray[np.int64]) -> Span:
        import av  # noqa: PLC0415 - slow

        self._open((index.codec, index.header, index.shape))
        begin, left = int(index.pts[packets[0]]), packets[1] - packets[0]
        with av.open(str(clip.path)) as container:
            source = container.streams.video[0]
            if self._stream is None:
                self._stream = self._output.add_stream_from_template(source, opaque=True)
                self._stream.time_base = source.time_base
            offset = round(self._time_s / index.time_base) - begin
            container.seek(begin, stream=source)
            for packet in container.demux(source):
                if packet.pts is None or packet.pts < begin:
                    continue
                packet.dts = (packet.pts if packet.dts is None else packet.dts) + offset
                packet.pts += offset
                packet.stream = self._stream
                self._bytes += packet.size
                self._output.mux(packet)
                left -= 1
                if not left:
                    break
        frame_s = float(np.median(np.diff(index.shown))) * float(index.time_base) if len(index.pts) > 1 else clip.step
        self._time_s = float((int(index.pts[slice(*packets)].max()) + offset) * index.time_base) + frame_s
        from_s = float((int(times[0]) + offset) * index.time_base)
        return Span(self._file, from_s, from_s + clip.count * clip.step)

    def _encode(self, clip: Clip, index: _Index) -> Span:
        if index.codec not in _ENCODERS:
            cut = f"to cut {index.codec} within a group of pictures, its frames are encoded again"
            raise BadInputError(f"{clip.path}: {cut}, which is known of {', '.join(_ENCODERS)}")
        self._open((_ENCODERS[index.codec], index.shape))
        if self._stream is None:
            self._stream = self._output.add_stream(_ENCODERS[index.codec], rate=self._fps, options=_OPTIONS)
            self._stream.width, self._stream.height, self._stream.pix_fmt = index.shape
        from_s, number = self._time_s, round(self._time_s * self._fps)
        self._time_s = from_s + clip.count / self._fps
        for count, frame in enumerate(_decode(clip)):
            frame.pts, frame.time_base = number + count, Fraction(1, self._fps)
            frame.pict_type = 1 if count == 0 else 0  # each clip begins with a key frame
            for packet in self._stream.encode(frame):
                self._bytes += packet.size
                self._output.mux(packet)
        return Span(self._file, from_s, self._time_s)

    def _open(self, kind: object) -> None:
        """Go on in this file, or begin another where the codec is another or it is full."""
        if kind == self._kind and self._bytes < layout.VIDEO_FILE_SIZE_MB * 2**20:
            return
        import av  # noqa: PLC0415 - slow

        self.close()
        self._file += 1
        chunk, file = divmod(self._file, layout.CHUNK_SIZE)
        path = self._root / layout.VIDEO_PATH.format(video_key=self._name, chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._output, self._stream, self._kind = av.open(str(path), "w"), None, kind
        self._time_s, self._bytes = 0.0, 0

    def close(self) -> None:
        """Finish the last file."""
        if self._output is not None:
            if self._kind and len(self._kind) == 2:  # type: ignore[arg-type]  # what the encoder still has
                self._output.mux(self._stream.encode())
            self._output.close()
        self._output = None
