"""The consonants made with the lips, whose errors viewers can see."""

from collections.abc import Sequence

from kouxing.corpora.scoring import align_symbols
from kouxing.shared.phones.inventory import PhoneInventory

_VISEMES = {"b", "f"}  # visemes of b p m and of f


class LabialCounts:
    """Counts spoken labials, recognized labials, and labials that are both."""

    def __init__(self, inventory: PhoneInventory) -> None:
        visemes = inventory.visemes
        self._labials = {phone for phone in inventory.phones if visemes[phone][0][0] in _VISEMES}
        self._num_spoken = self._num_recognized = self._num_both = 0

    def add(self, reference: Sequence[str], recognized: Sequence[str]) -> None:
        """Count the phones of a recording."""
        for i, j in align_symbols(reference, recognized):
            is_spoken = i is not None and reference[i] in self._labials
            is_recognized = j is not None and recognized[j] in self._labials
            self._num_spoken += is_spoken
            self._num_recognized += is_recognized
            self._num_both += is_spoken and is_recognized

    def rates(self) -> dict[str, float | None]:
        """Return recall and precision, any labial counting for any other; None without phones."""
        return {
            name: self._num_both / total if total else None
            for name, total in (("recall", self._num_spoken), ("precision", self._num_recognized))
        }
