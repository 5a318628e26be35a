"""One run of the daemon, put together: device, reader, pipeline, sinks, recorder.

The ROS node and the command line are two users of it; neither is needed. Threads: ``reader``
(acquisition), ``pipeline`` (processing), ``recorder`` while recording; the caller's own thread
opens, asks and closes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from psd_deflection.config import Rig, replace_values
from psd_deflection.pipeline import Pipeline
from psd_deflection.records import ParameterChange
from psd_deflection.runner.acquisition import Acquisition
from psd_deflection.runner.fanout import Fanout
from psd_deflection.runner.processing import Processing
from psd_deflection.runner.recorder import Recorder
from psd_deflection.runner.simulated_rig import SimulatedRigProcess


class Session:
    """Opens on construction. ``say``: told of changes of state, one line each, from any thread; so
    is whoever else is put on ``listeners``.

    Raises DeviceError, ConfigError, SolverError or RecordingError where the run cannot start.
    """

    def __init__(self, rig: Rig, say: Callable[[str], None]) -> None:
        self._simulated: SimulatedRigProcess | None = None
        self._closed = False
        self.listeners: list[Callable[[str], None]] = [say]
        say = self._tell
        # The geometry first: a rig that cannot be solved must not open a port.
        pipeline = Pipeline(rig)
        if not rig.acquisition.port:
            self._simulated = SimulatedRigProcess(rig)
            rig = replace_values(rig, {'port': self._simulated.port})
            pipeline = Pipeline(rig)
            say(f'no port given: started the simulated rig on {self._simulated.port} (--port names a real one)')
        try:
            self.acquisition = Acquisition(rig, say)
            self.acquisition.open()
            self.processing = Processing(self.acquisition, pipeline, say)
            self.recorder = Recorder(rig.acquisition.queue_blocks, say)
            self.fanout = Fanout()
            self.fanout.change_wires.append(self.recorder)
            self.processing.sinks.append(self.fanout)
        except BaseException:
            if self._simulated is not None:
                self._simulated.close()
            raise

    def _tell(self, text: str) -> None:
        for listener in tuple(self.listeners):
            listener(text)

    @property
    def pipeline(self) -> Pipeline:
        """The pipeline; only its counters and last records are for other threads."""
        return self.processing.pipeline

    @property
    def rig(self) -> Rig:
        """The rig with its present zero."""
        return self.pipeline.rig

    @property
    def simulated(self) -> bool:
        """Whether the device is the simulated rig that this session started."""
        return self._simulated is not None

    @property
    def failed(self) -> BaseException | None:
        """What ended the pipeline thread, if something did."""
        return self.processing.failed

    def start(self) -> None:
        """Start recording where the rig says so, and let samples flow.

        The recorder is served last: what is published waits for no disk.
        """
        self.fanout.wires.append(self.recorder)
        if self.rig.acquisition.record:
            self.record(True)
        self.processing.start()
        self.acquisition.start()

    def record(self, wanted: bool) -> Path | None:
        """Start or stop a recording between two blocks; its folder, or None where none was made.

        Raises RecordingError where it cannot start.
        """
        hello = self.acquisition.hello.info if self.acquisition.hello is not None else None

        def change() -> Path | None:
            return self.recorder.start(self.rig, hello) if wanted else self.recorder.stop()

        return self.processing.request(change)

    def zero(self) -> ParameterChange | None:
        """Take the present dots as the unloaded ones; None where no good block has come yet.

        Raises TimeoutError where no data flows.
        """

        def change() -> ParameterChange | None:
            taken = self.pipeline.zero()
            if taken is not None:
                self.processing.give([taken])
            return taken

        return self.processing.request(change)

    def set_sum_min(self, volts: float) -> None:
        """Change the level below which a laser counts as lost, V, between two blocks.

        Raises TimeoutError where no data flows.
        """
        self.processing.request(lambda: self.processing.give([self.pipeline.change({'sum_min': volts})]))

    def close(self) -> Path | None:
        """Stop reading, process what was read, end the recording; returns its folder.

        Does nothing the second time.
        """
        if self._closed:
            return None
        self._closed = True
        self.acquisition.stop()
        self.processing.join()
        folder = self.recorder.stop()
        if self._simulated is not None:
            self._simulated.close()
        return folder
