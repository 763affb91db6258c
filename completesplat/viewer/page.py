"""The page: what its controls of looking and saving do."""

import logging
from collections.abc import Sequence
from functools import partial

import viser

from completesplat.errors import CompleteSplatError
from completesplat.viewer.controls import SIDE_BY_SIDE, add_looking, add_saving
from completesplat.viewer.samples import Sample
from completesplat.viewer.saving import Saver
from completesplat.viewer.server import stop_server
from completesplat.viewer.stage import Stage
from completesplat.viewer.worker import Worker

log = logging.getLogger(__name__)


class Page:
    """Controls and scene of one server. What takes time happens in the thread of `worker`.

    Args:
        saver: writes the files.
        layers: how many can be switched on and off.
    """

    def __init__(self, server: viser.ViserServer, stage: Stage, saver: Saver, layers: int) -> None:
        self.server, self.stage, self.saver = server, stage, saver
        self.worker = Worker(self.tell)
        self.status = server.gui.add_markdown("", order=0)
        self.looking = add_looking(server.gui, layers, stage.data_cameras is not None)
        self._connect_looking()
        self.saving = add_saving(server.gui)
        for kind, button in self.saving.items():
            button.on_click(partial(self._save, kind))
        self.show(stage.samples)

    def show(self, samples: Sequence[Sample], status: str = "") -> None:
        """These samples from now on, in all browsers."""
        self.stage.show(samples)
        options = (SIDE_BY_SIDE, *(f"sample {i + 1}" for i in range(len(samples))))
        if self.looking.chosen.options != options:
            self.looking.chosen.options = options
        self.status.content = status

    def tell(self, error: Exception, client: viser.ClientHandle | None = None) -> None:
        """A message in the browser that asked, or in all; what is no refusal stands in the log as well."""
        text = str(error)
        if not isinstance(error, CompleteSplatError):
            text = f"{type(error).__name__}: {text}"
            log.error("the viewer goes on after %s", text, exc_info=error)
        for one in list(self.server.get_clients().values()) if client is None else [client]:
            one.add_notification("Not possible", text, color="red")

    def close(self) -> None:
        """End the thread and the server."""
        self.worker.close()
        stop_server(self.server)

    def _connect_looking(self) -> None:
        looking, stage = self.looking, self.stage

        def changed(_: viser.GuiEvent) -> None:
            index = looking.chosen.options.index(looking.chosen.value)
            stage.chosen = index - 1 if index else None
            stage.hidden_layers = {i for i, layer in enumerate(looking.layers) if not layer.value}
            stage.depth = looking.depth.value
            stage.cameras = {name for name, box in looking.cameras.items() if box.value}
            stage.refresh()

        looking.chosen.on_update(changed)
        for box in (*looking.layers, looking.depth, *looking.cameras.values()):
            box.on_update(changed)
        looking.front.on_click(lambda event: stage.look_from_the_front(event.client))

    def _save(self, kind: str, event: viser.GuiEvent) -> None:
        client = event.client
        if client is None:
            return

        def save() -> None:
            try:
                files = self.saver.save(kind, self.stage.shown)
            except CompleteSplatError as error:
                return self.tell(error, client)
            for file in files:
                client.send_file_download(file.name, file.read_bytes())
            self.status.content = f"saved {', '.join(file.name for file in files)} in {self.saver.folder}"

        self.worker.submit(kind, save)
