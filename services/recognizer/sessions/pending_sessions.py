"""Sessions that wait for their acoustic model, which a thread loads."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.languages import load_model_for_language
from kouxing.shared.errors import StartFailure, UserError
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import ErrorCode


class PendingSessions:
    """Queues sessions while a thread loads their acoustic model.

    The model for ``language`` is loaded already. The thread calls ``on_loaded`` after each model.
    """

    def __init__(self, language: str, on_loaded: Callable[[], None]) -> None:
        self._language = language
        self._on_loaded = on_loaded
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="models")
        self._models: dict[str, Future[AcousticModel]] = {}  # by language
        self._starts: dict[str, StartSession] = {}  # by session

    def add(self, start: StartSession) -> bool:
        """Queue a session whose model is not loaded yet; return whether it was queued.

        Raises ``StartFailure`` if no model has the language, or its model cannot be loaded. The
        next session with this language tries again.
        """
        language = start.facts.language
        if language in (None, self._language):
            return False
        if language not in self._models:
            loading = self._executor.submit(load_model_for_language, language)
            loading.add_done_callback(lambda _: self._on_loaded())
            self._models[language] = loading
        if self._models[language].done():
            try:
                self._models[language].result()
            except UserError as error:
                del self._models[language]
                raise StartFailure(ErrorCode.BAD_LANGUAGE, str(error)) from error
            except (OSError, MemoryError) as error:
                del self._models[language]
                reason = str(error) or "not enough memory"
                text = f"the acoustic model for {language} cannot be loaded: {reason}"
                raise StartFailure(ErrorCode.NO_SERVICE, text) from error
            return False
        self._starts[start.session] = start
        return True

    def remove(self, session: str) -> None:
        """Remove a session from the queue, if it is queued."""
        self._starts.pop(session, None)

    def set_face(self, session: str, face: FaceSettings) -> None:
        """Change the face of a session, if it is queued."""
        if (start := self._starts.get(session)) is not None:
            self._starts[session] = start.with_face(start.opening.face.merged_with(face))

    def take_ready(self) -> list[StartSession]:
        """Remove and return the sessions whose model is loaded, or could not be loaded."""
        ready = [start for start in self._starts.values() if not self._is_loading(start)]
        for start in ready:
            del self._starts[start.session]
        return ready

    def _is_loading(self, start: StartSession) -> bool:
        loading = self._models.get(start.facts.language or self._language)
        return loading is not None and not loading.done()
