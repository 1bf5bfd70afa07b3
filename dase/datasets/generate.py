"""Many labelled event sequences from pictures: the work behind `dase synth`."""

from __future__ import annotations

import gc
import os
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from hashlib import sha256
from itertools import zip_longest
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import tomlkit
from numpy.typing import NDArray

from dase import io
from dase.datasets.steps_in_order import StepsInOrder
from dase.datasets.worker_start import worker_context
from dase.effects.exposure import Exposure
from dase.errors import InputError, checked_integer, nearest
from dase.events import read_only
from dase.files.folder_lock import locking_folder
from dase.files.interrupt import DeferredInterrupt, WorkerLife, defer_interrupt, ignore_interrupt
from dase.files.text_files import read_text_file
from dase.io.source import Source
from dase.kernels import launch
from dase.kernels.threads import thread_count
from dase.scenes import image_sources, random_scenes
from dase.scenes.layers import LayerScene
from dase.scenes.scene import SamplingSettings, Scene, to_grey
from dase.scenes.stereo import StereoPair, stereo_pair
from dase.simulation.pixel_array import PixelArray
from dase.simulation.sensor import Sensor
from dase.simulation.sensor_file import dump_sensor, parse_sensor
from dase.simulation.sensor_run import SensorRun, UnreadChunk, sample_times
from dase.simulation.user_effects import known_effects
from dase.version import __version__

RECORD_FILE = "synth.toml"
"""File beside the sequences that holds everything that made them."""
LONGEST_SEQUENCE = 36000.0
"""Of one sequence [s]: times of all samples are held in memory, up to 1000 of them in a second."""
MOST_FRAMES = 10_000_000
"""Stored with one sequence."""
LEAST_TRAVEL = 0.01
"""Between two samples [px]: a sixteenth has the events of a fiftieth within a two-hundredth already."""


@dataclass(frozen=True, kw_only=True)
class DatasetJob:
    """Everything that determines the bytes of a data set.

    Args:
        images: As `dase.scenes.image_sources.open_images` takes it.
        sensor: TOML text of the sensor.
        sequences: How many.
        width: Columns [px].
        height: Rows [px].
        duration: Of each sequence [s].
        regime: One of `dase.scenes.random_scenes.REGIME_NAMES`.
        seed: Of scenes and sensors.
        format: Suffix of the files, without the dot.
        backend: `cpu` or `cuda`; they agree to float32 rounding, not to the byte.
        frame_rate: Of frames and flow [Hz].
        labels: Whether events are marked with what they came from.
        effects: Files with effects of the user's own that the sensor names.
        exposure: Of each frame [s], at most a frame's period; 0 for frames taken in an instant. The frames
            are blurred as they would be, and the effect `exposure` of the sensor is in step with them.
        stereo: Baseline of a pair of cameras [m], 0 for one camera. Each sequence then has a file for the
            left and one for the right camera, with disparity and depth at the frames' times beside each.
        focal: Focal length of the pair [px], 0 for as long as the picture is wide.
        depths: Of the nearest and the farthest layer of a pair [m]; layers lie at random between.
        travel: Share of a pixel that anything moves between two samples of the light: less is nearer to the
            light itself, and takes as much longer.
    """

    images: str
    sensor: str
    sequences: int
    width: int
    height: int
    duration: float
    regime: str
    seed: int = 0
    format: str = "h5"
    backend: str = "cpu"
    frame_rate: float = 60.0
    labels: bool = False
    effects: tuple[str, ...] = ()
    exposure: float = 0.0
    stereo: float = 0.0
    focal: float = 0.0
    depths: tuple[float, float] = (1.0, 10.0)
    travel: float = SamplingSettings.travel

    def __post_init__(self) -> None:
        if self.sequences < 1:
            raise InputError(f"sequences must be >= 1, got {self.sequences}")
        if self.width < 1 or self.height < 1:
            raise InputError(f"size must be at least 1x1, got {self.width}x{self.height}")
        for name in ("duration", "frame_rate"):
            value = getattr(self, name)
            if not np.isfinite(value) or value <= 0:
                raise InputError(f"{name.replace('_', ' ')} must be a number > 0, got {value:g}")
        if self.duration > LONGEST_SEQUENCE:
            raise InputError(
                f"duration must be at most {LONGEST_SEQUENCE:g} s, got {self.duration:g}: make more sequences"
            )
        if self.duration * self.frame_rate > MOST_FRAMES:
            raise InputError(
                f"frame rate must give at most {MOST_FRAMES:,} frames in {self.duration:g} s, "
                f"got {self.frame_rate:g}"
            )
        if self.exposure > self.duration:
            raise InputError(
                f"exposure must be at most the duration, {self.duration:g} s, got {self.exposure:g}"
            )
        _check_exposure(self.exposure, self.frame_rate)
        if not (np.isfinite((self.stereo, self.focal)).all() and min(self.stereo, self.focal) >= 0):
            raise InputError(
                f"stereo: baseline and focal must be numbers >= 0, got {self.stereo:g} and {self.focal:g}"
            )
        if not 0 < self.depths[0] <= self.depths[1] < np.inf:
            raise InputError(f"depths must be 0 < nearest <= farthest, got {self.depths}")
        if not LEAST_TRAVEL <= self.travel <= 1:
            raise InputError(f"travel must be {LEAST_TRAVEL:g} to 1 px, got {self.travel:g}")
        if self.regime not in random_scenes.REGIME_NAMES:
            raise InputError(
                f"there is no regime '{self.regime}': {nearest(self.regime, random_scenes.REGIME_NAMES)}"
            )
        checked_integer("seed", self.seed, 0)

    def text(self) -> str:
        """Return the job as TOML text."""
        document = tomlkit.document()
        document.add("dase", __version__)
        for name, value in asdict(self).items():
            # what is off is not said, so that a record stays what it was before there was such a thing
            off = name in ("exposure", "stereo") and not value
            off = off or (name in ("focal", "depths") and not self.stereo)
            off = off or (name == "travel" and value == SamplingSettings.travel)
            if name not in ("sensor", "effects") and not off:
                document.add(name, list(value) if isinstance(value, tuple) else value)
        if self.effects:  # what is in the files determines the bytes, not where they lie
            files = (Path(path) for path in self.effects)
            document.add("effects", [f"{f.name} sha256:{sha256(f.read_bytes()).hexdigest()}" for f in files])
        sensor = tomlkit.table(is_super_table=False)
        used = dump_sensor(_sensor_of(self)) if self.exposure else self.sensor
        for key, item in tomlkit.parse(used).items():
            sensor.add(key, item)
        document.add("sensor", sensor)
        return tomlkit.dumps(document)

    @property
    def files(self) -> int:
        """How many files of events there are: one of each sequence and camera."""
        return self.sequences * (2 if self.stereo else 1)

    def view(self, index: int) -> tuple[int, str]:
        """Return the sequence of a file and its camera, left or right, "" where there is only one."""
        if not self.stereo:
            return index, ""
        return index // 2, ("left", "right")[index % 2]

    def path(self, out: Path, index: int) -> Path:
        """Return a file of events by its number, that of its sequence where there is one camera."""
        sequence, view = self.view(index)
        return out / f"sequence_{sequence:05d}{'_' * bool(view)}{view}.{self.format}"

    def truth_path(self, out: Path, index: int) -> Path:
        """Return the file of disparity and depth beside that of the events of one camera of a pair."""
        path = self.path(out, index)
        return path.with_name(f"{path.stem}_truth.npz")


@dataclass(frozen=True)
class WorkReport:
    """What one or more sequences cost and gave.

    Args:
        sequences: How many were made.
        events: In all.
        samples: Time samples rendered, the number a user pays for.
        pixels: Pixel samples: samples times pixels.
        seconds: Wall time [s].
    """

    sequences: int = 0
    events: int = 0
    samples: int = 0
    pixels: int = 0
    seconds: float = 0.0

    def plus(self, other: WorkReport) -> WorkReport:
        """Return the sum of two reports."""
        return WorkReport(
            *(a + b for a, b in zip(asdict(self).values(), asdict(other).values(), strict=True))
        )


def generate_dataset(
    job: DatasetJob,
    out: Path,
    *,
    jobs: int = 1,
    resume: bool = False,
    progress: Callable[[WorkReport], None] = lambda report: None,
    say: Callable[[str], object] = lambda line: None,
) -> WorkReport:
    """Make all sequences of a job, each an atomic file, and return what they cost.

    Args:
        job: What to make; the same job gives the same bytes whatever `jobs` is.
        out: Folder, made if missing.
        jobs: Processes that share the work.
        resume: Keep the sequences that an interrupted run of the same job has left. They are known by the
            record of the job in each file, and read through: what is damaged is made again, what is of
            another job is set aside.
        progress: Called with the report of each finished sequence.
        say: Takes lines about what was damaged or set aside.

    Raises:
        InputError: `out` holds other work or is being written by another process, something in the job does
            not exist, or a worker process was ended from outside.
    """
    if jobs < 1:
        raise InputError(f"jobs must be >= 1, got {jobs}")
    begin = time.perf_counter()
    # what cannot work is refused before the folder is made or a process started
    image_sources.open_images(job.images)
    PixelArray(_sensor_of(job), 1, 1, device=job.backend)
    _check_record(job, out, resume)
    total = WorkReport()
    with defer_interrupt() as interrupt, locking_folder(out):
        todo = _prepare_folder(job, out, resume, say)
        # closing ends the processes when `progress` raises
        with closing(_make_sequences(job, out, todo, min(jobs, max(len(todo), 1)), interrupt)) as reports:
            for report in reports:
                total = total.plus(report)
                progress(report)
    return replace(total, seconds=time.perf_counter() - begin)


def _check_record(job: DatasetJob, out: Path, resume: bool) -> None:
    """Raise InputError where the folder holds other work."""
    record = out / RECORD_FILE
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} must be a folder, but it is a file")
    if record.exists():
        if not resume:
            raise InputError(
                f"{out} already holds a data set; resume it, or give another folder", argument="resume"
            )
        if read_text_file(record, "the record", 1 << 24) != job.text():
            raise InputError(
                f"{out} was begun with other options (see {record}); to resume takes the same ones"
            )
    elif not resume:
        there = next((path for i in range(job.files) if (path := job.path(out, i)).exists()), None)
        if there is not None:
            raise InputError(
                f"{out} holds '{there.name}', but no {RECORD_FILE} that says what made it: "
                "choose another folder, or resume to keep what is of this job"
            )


def _prepare_folder(job: DatasetJob, out: Path, resume: bool, say: Callable[[str], object]) -> list[int]:
    """Leave the record in a folder that is locked, and return the sequences still to be made."""
    _check_record(job, out, resume)  # again: another run may just have ended
    with io.replacing(out / RECORD_FILE) as temporary:
        temporary.write_bytes(job.text().encode())
    return [i for i in range(job.files) if not _is_made(job, out, i, say)]


def _is_made(job: DatasetJob, out: Path, index: int, say: Callable[[str], object]) -> bool:
    """Whether a sequence is there: whole, and by its own record of this job."""
    path = job.path(out, index)
    if not path.exists() or (job.stereo and not _is_truth(job.truth_path(out, index))):
        return False
    try:
        for _ in io.stream(path):
            pass  # to the end: a file may be cut or damaged anywhere
        for _ in io.pictures(path):
            pass
        found = io.find_format(path).beside(Source(path, None, []))[1]
    except InputError as error:
        say(f"{error}: made again")
        return False
    if found == _configuration(job, index):
        return True
    aside = next(
        place for n in range(10**6) if not (place := path.with_name(f"{path.name}.other{n or ''}")).exists()
    )
    os.rename(path, aside)
    say(f"{path} is of another job: set aside as '{aside.name}', and made again")
    return False


def _is_truth(path: Path) -> bool:
    """Whether a file of disparity and depth is whole."""
    try:
        with np.load(path) as found:
            return all(len(found[name]) == len(found["times"]) for name in ("disparity", "depth"))
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return False


def _make_sequences(
    job: DatasetJob, out: Path, todo: list[int], jobs: int, interrupt: DeferredInterrupt
) -> Generator[WorkReport, None, None]:
    if jobs == 1:
        yield from _make_here(job, out, todo, interrupt)
        return
    context = worker_context()
    stop = context.RawValue("b", 0)  # no lock with it, which a worker that is killed could hold for ever
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_worker, initargs=(stop,))
    try:
        with ignore_interrupt():
            early = [pool.submit(_open_device, job) for _ in range(jobs)]
        # compiles the kernels once, before the processes race for it, while these start
        _warm_up(job)
        left = {
            # the last ones get the cores of processes that find nothing more to do
            pool.submit(_in_worker, job, out, index, max(thread_count() // min(jobs, len(todo) - n), 1))
            for n, index in enumerate(todo)
        }
        for started in early:
            started.result()
        while left:
            # not longer, so that Ctrl-C is obeyed at once although nothing finishes
            done, left = wait(left, timeout=0.1, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
            interrupt.check()
    except BrokenProcessPool:
        interrupt.check()  # a signal to the whole group ends the workers, too
        raise InputError(
            f"{out}: a worker process was ended from outside, perhaps for want of memory: "
            "resume with fewer processes",
            argument="jobs",
        ) from None
    finally:
        # workers end at their next chunk and leave no half-written file behind
        stop.value = 1
        pool.shutdown(cancel_futures=True)


def _make_here(
    job: DatasetJob, out: Path, todo: list[int], interrupt: DeferredInterrupt, most_open: int = 4
) -> Generator[WorkReport, None, None]:
    """Make sequences in this process; pixels of one work while those before it are read out and written."""
    begun: deque[_Recording] = deque()
    # the next scene is drawn while this one is before the sensor
    with ThreadPoolExecutor(1, thread_name_prefix="dase scenes") as drawing:
        try:
            drawn = [drawing.submit(_draw_sequence, job, index) for index in todo[:1]]
            for index, after in zip_longest(todo, todo[1:]):
                scene, times = drawn.pop().result()
                if after is not None:
                    drawn.append(drawing.submit(_draw_sequence, job, after))
                begun.append(_begin_sequence(job, out, index, scene, times))
                begun[-1].simulate(lambda done: interrupt.check())
                # each holds its events until they are written
                if len(begun) >= min(thread_count(), most_open):
                    yield begun[0].finish(lambda done: interrupt.check())
                    begun.popleft()
            while begun:
                yield begun[0].finish(lambda done: interrupt.check())
                begun.popleft()
        except BaseException as error:
            for recording in begun:
                recording.abandon(error)
            raise


def _warm_up(job: DatasetJob) -> None:
    source = image_sources.open_images(job.images)
    scene = random_scenes.draw_scene(
        np.random.default_rng(0), source, "background", width=8, height=8, duration=0.02
    )
    run = SensorRun(scene, _sensor_of(job), device=job.backend, labels=job.labels)
    run.events()
    if job.exposure:
        scene.exposed_frames(np.zeros(1), scene.duration, job.backend)
    else:
        scene.grey_frames(np.zeros(1), job.backend)
    scene.flow(np.zeros(1), job.backend)
    run.thresholds()


def _begin_worker(stop: Any) -> None:
    global _life
    gc.freeze()  # what was imported stays: no collection has to go through it again
    _life = WorkerLife(stop)


def _open_device(job: DatasetJob) -> None:
    """Have the device of a worker ready before there is work: a GPU's needs half a second."""
    PixelArray(_sensor_of(job), 1, 1, device=job.backend)


_life: WorkerLife | None = None
"""In a worker process: what ends it."""


def _in_worker(job: DatasetJob, out: Path, index: int, threads: int) -> WorkReport:
    assert _life is not None
    with _life.busy:
        # the processes share the cores: more threads of each would compete for them
        launch.set_threads(threads)
        return make_sequence(job, out, index, _life.interrupt)


@lru_cache(maxsize=1)
def _open_images_once(spec: str, colour: bool) -> image_sources.ImageSource:
    return image_sources.open_images(spec, colour=colour)


@lru_cache(maxsize=1)  # a file of effects is read once, whatever becomes of it meanwhile
def _sensor_of(job: DatasetJob) -> Sensor:
    sensor = parse_sensor(job.sensor, "sensor", known_effects(job.effects))
    return _couple_frames(sensor, job.frame_rate, job.exposure, 0.0)


def _couple_frames(sensor: Sensor, frame_rate: float, exposure: float, begin: float) -> Sensor:
    """Return the sensor with its frame coupling, if it has one, in step with the frames that are stored."""
    if not exposure:
        return sensor
    effects = (
        effect.at_frames(1 / frame_rate, exposure, begin) if isinstance(effect, Exposure) else effect
        for effect in sensor.effects
    )
    return replace(sensor, effects=tuple(effects))


def _check_exposure(exposure: float, frame_rate: float) -> None:
    if not (np.isfinite(exposure) and exposure >= 0):
        raise InputError(f"exposure must be a number >= 0 s, got {exposure:g}")
    if exposure * frame_rate > 1 + 1e-9:
        raise InputError(
            f"exposure must be at most the frames' period, {1 / frame_rate:g} s, got {exposure:g}: "
            "expose shorter, or lower the frame rate"
        )


def _exposure_begins(
    first: float, duration: float, frame_rate: float, exposure: float
) -> NDArray[np.float64]:
    """Return when frames begin [s] whose exposures end within a scene of `duration` [s] from `first` on."""
    begins = np.arange(0, duration, 1 / frame_rate)
    return first + begins[begins + exposure <= duration * (1 + 1e-9)]


def make_scene(job: DatasetJob, index: int) -> LayerScene:
    """Return the scene of one file of events."""
    sequence, view = job.view(index)
    if view:
        return getattr(make_pair(job, sequence), view)  # type: ignore[no-any-return]
    return _draw_scene(job, sequence)


def make_pair(job: DatasetJob, sequence: int) -> StereoPair:
    """Return what both cameras see of one sequence, its layers at random depths."""
    scene = _draw_scene(job, sequence)
    rng = np.random.default_rng([job.seed, sequence, 2])
    near, far = np.log(job.depths)
    depths = np.sort(np.exp(rng.uniform(near, far, len(scene.layers))))[::-1]
    return stereo_pair(scene, depths.tolist(), baseline=job.stereo, focal=job.focal or job.width)


def _write_truth(job: DatasetJob, out: Path, index: int, times: NDArray[np.float64]) -> None:
    """Write disparity and depth of one camera at `times` [s], shape (F,)."""
    sequence, view = job.view(index)
    disparity, depth = make_pair(job, sequence).labels(times, job.backend, right=view == "right")
    with io.replacing(job.truth_path(out, index)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, times=times, disparity=disparity, depth=depth)


def _draw_scene(job: DatasetJob, sequence: int) -> LayerScene:
    rng = np.random.default_rng([job.seed, sequence])
    return random_scenes.draw_scene(
        rng,
        _open_images_once(job.images, _sensor_of(job).sees_colour()),
        job.regime,
        width=job.width,
        height=job.height,
        duration=job.duration,
        travel=job.travel,
    )


def _sensor_seed(job: DatasetJob, index: int) -> int:
    """Return the seed of the sensor: sequences share neither scene nor pixels' random numbers."""
    return int(np.random.default_rng([job.seed, index, 1]).integers(2**31))


def _configuration(job: DatasetJob, index: int) -> str:
    """Return the text in the file of a sequence, which says of what job it is."""
    sequence, view = job.view(index)
    camera = f'camera = "{view}"\n' if view else ""
    seed = _sensor_seed(job, index)
    return job.text() + f"\n[sequence]\nindex = {sequence}\n{camera}sensor_seed = {seed}\n"


def make_sequence(job: DatasetJob, out: Path, index: int, interrupt: DeferredInterrupt) -> WorkReport:
    """Simulate one sequence and write its file; an interrupt leaves nothing and raises KeyboardInterrupt."""
    recording = _begin_sequence(job, out, index, *_draw_sequence(job, index))
    return recording.record(lambda done: interrupt.check())


def _draw_sequence(job: DatasetJob, index: int) -> tuple[LayerScene, NDArray[np.float64]]:
    """Return the scene of a sequence, and when the sensor samples it [s], shape (K,)."""
    scene = make_scene(job, index)
    return scene, sample_times(scene, _sensor_of(job))


def _begin_sequence(
    job: DatasetJob, out: Path, index: int, scene: LayerScene, times: NDArray[np.float64]
) -> _Recording:
    begin = time.perf_counter()
    run = SensorRun(
        scene, _sensor_of(job), times=times, seed=_sensor_seed(job, index), device=job.backend,
        labels=job.labels,
    )  # fmt: skip
    begins = _exposure_begins(0.0, scene.duration, job.frame_rate, job.exposure)
    if job.stereo:
        _write_truth(job, out, index, begins + job.exposure / 2)
    return _Recording(job.path(out, index), _configuration(job, index), run, begins, job.exposure, begin)


class _Recording:
    """A file with thresholds, frames, flow and events of a run, in order of time.

    The caller's thread does what may need a GPU: the pixels, frames and flow. What leaves the pixels is read
    out and written beside that.

    Args:
        path: File to write.
        configuration: TOML text of everything that made it.
        run: Sensor and scene.
        begins: When the frames' exposures begin [s], increasing, shape (F,).
        exposure: Of each frame [s]; frames and flow are stored at the middle of it.
        begin: When the work on it began, by `time.perf_counter` [s].
    """

    def __init__(
        self,
        path: Path,
        configuration: str,
        run: SensorRun,
        begins: NDArray[np.float64],
        exposure: float,
        begin: float,
    ):
        self._run, self._begins, self._exposure, self._begin = run, begins, exposure, begin
        self._shown = run.sensor.in_frames(run.scene)
        self._total = WorkReport(sequences=1)
        self._steps: StepsInOrder[io.Writer, WorkReport] = StepsInOrder(io.create(path))
        self._configuration = configuration

    def record(self, progress: Callable[[WorkReport], None]) -> WorkReport:
        """Do all of it; `progress` is called with the report of each chunk, on this thread."""
        try:
            self.simulate(progress)
            return self.finish(progress)
        except BaseException as error:
            self.abandon(error)
            raise

    def simulate(self, progress: Callable[[WorkReport], None]) -> None:
        """Go through the scene. The end may still have to be read out and written then."""
        run, scene = self._run, self._run.scene
        thresholds = run.thresholds()[0].reshape(2, scene.height, scene.width)

        def begin(writer: io.Writer) -> WorkReport:
            writer.configuration(self._configuration)
            writer.thresholds(thresholds)
            return WorkReport()

        self._add(begin, progress)
        shown, frame_times = 0, self._begins + self._exposure / 2
        for chunk in run.unread_chunks():
            # frames go before the events of their chunk: readers of the file meet both in order of time
            due = (
                int(np.searchsorted(frame_times, chunk.times[-1], side="right"))
                if len(chunk.times)
                else shown
            )
            self._add(self._write_chunk(chunk, *self._render(self._begins[shown:due])), progress)
            shown = due
        self._steps.end()

    def _add(self, step: Callable[[io.Writer], WorkReport], progress: Callable[[WorkReport], None]) -> None:
        self._steps.add(step)
        for done in self._steps.results():
            self._count(done, progress)

    def _count(self, done: WorkReport, progress: Callable[[WorkReport], None]) -> None:
        self._total = self._total.plus(done)
        progress(done)

    def _render(
        self, begins: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[Any], NDArray[np.float32] | None]:
        """Return times [s], frames and flow of the frames that begin at `begins` [s], each of length F."""
        scene, device = self._shown, self._run.pixel_array.device.alias
        middles = begins + self._exposure / 2
        if not len(begins):
            return middles, np.empty(0), None
        if self._exposure:
            frames = to_grey(scene.exposed_frames(begins, self._exposure, device))
        else:
            frames = scene.grey_frames(begins, device)
        flow = scene.flow(middles, device)
        return middles, read_only(frames), None if flow is None else read_only(flow)

    def _write_chunk(
        self,
        chunk: UnreadChunk,
        times: NDArray[np.float64],
        frames: NDArray[Any],
        flow: NDArray[np.float32] | None,
    ) -> Callable[[io.Writer], WorkReport]:
        samples, pixels = len(chunk.times), self._run.pixel_array.count

        def write(writer: io.Writer) -> WorkReport:
            (events,) = chunk.read()
            events = events.read_only()
            for i, at in enumerate(times):
                writer.frame(float(at), frames[i], None if flow is None else flow[i], exposure=self._exposure)
            if samples or len(events):
                writer.events(events)
            return WorkReport(0, len(events), samples, samples * pixels)

        return write

    def finish(self, progress: Callable[[WorkReport], None]) -> WorkReport:
        """Wait until the file is whole and under its name, and return what it cost and gave."""
        while not self._steps.is_done():
            for done in self._steps.results():
                self._count(done, progress)
        for done in self._steps.results():
            self._count(done, progress)
        return replace(self._total, seconds=time.perf_counter() - self._begin)

    def abandon(self, error: BaseException) -> None:
        """Leave no file behind, as after `error`."""
        self._steps.abandon(error)


def record_scene(
    scene: Scene,
    sensor: Sensor,
    path: Path,
    *,
    frame_rate: float = 60.0,
    seed: int = 0,
    device: str = "cpu",
    labels: bool = False,
    exposure: float = 0.0,
    progress: Callable[[WorkReport], None] = lambda report: None,
) -> WorkReport:
    """Simulate any scene into one file.

    Args:
        scene: What the sensor sees.
        sensor: What it does.
        path: File to write, in the format of its suffix.
        frame_rate: Highest rate of the samples that are also stored as frames [Hz].
        seed: Of every random number.
        device: `cpu`, `cuda` or a Warp name.
        labels: Whether events are marked with what they came from.
        exposure: Of each frame [s], see `DatasetJob`. Frames then begin at the first sample and every
            1 / frame_rate behind it.
        progress: Called with the report of each finished chunk.
    """
    begin = time.perf_counter()
    if not np.isfinite(frame_rate) or frame_rate <= 0:
        raise InputError(f"frame rate must be a number > 0, got {frame_rate:g}")
    _check_exposure(exposure, frame_rate)
    times = scene.sample_times()
    # the first sample of each frame period; a slack of 1e-6 of it keeps equal rates equal
    period = np.floor((times - times[0]) * frame_rate + 1e-6)
    # samples themselves, as a scene of frames is not known between them
    begins = times[np.concatenate([[True], np.diff(period) > 0])]
    if exposure:
        first = float(times[0])
        begins = _exposure_begins(first, scene.duration, frame_rate, exposure)
        sensor = _couple_frames(sensor, frame_rate, exposure, first)
    run = SensorRun(scene, sensor, seed=seed, device=device, labels=labels)
    # its history says how the sensor came to be, which no event depends on
    model = dump_sensor(replace(sensor, history=()))
    configuration = model + f'\n[run]\ndase = "{__version__}"\nseed = {seed}\n'
    with defer_interrupt() as interrupt:

        def advance(done: WorkReport) -> None:
            interrupt.check()
            progress(done)

        return _Recording(path, configuration, run, begins, exposure, begin).record(advance)
