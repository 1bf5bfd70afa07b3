"""What an effect says of the signatures that it makes, and which effects of a library make one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dase.errors import InputError, nearest
from dase.signatures.kinds import KINDS
from dase.signatures.result import Signature

if TYPE_CHECKING:
    from dase.effects.base import Effect


@dataclass(frozen=True)
class Makes:
    """A signature that an effect makes in the events of a camera.

    Args:
        signature: Its name, one of `dase.signatures.kinds.KINDS`.
        tells: Whether the signature by itself tells that it is this effect, or one of those of the library
            that say so, too. Otherwise it tells what there is, and not what makes it.
        by: The detail without which it does not tell, see `SignatureKind.ways`; "" where it always does.
        absence: Whether a signature that tells does so by its absence, too: where it is not seen, a diagnosis
            says that the effect would have been. False for an effect that something else often hides.
        usual: Whether it is the effect that makes the signature in most cameras: it is named first where
            nothing tells which it is.
    """

    signature: str
    tells: bool = False
    by: str = ""
    absence: bool = True
    usual: bool = False

    def __post_init__(self) -> None:
        if self.signature not in KINDS:
            raise InputError(
                f"there is no signature {self.signature!r}: {nearest(str(self.signature), KINDS)}"
            )
        ways = KINDS[self.signature].ways
        if self.by and self.by not in ways:
            known = f"must be one of {', '.join(ways)}" if ways else "must be empty"
            raise InputError(f"signature '{self.signature}': by {known}, got {self.by!r}")
        if self.by and not self.tells:
            raise InputError(f"signature '{self.signature}': by = {self.by!r} needs tells = True")

    def is_told_by(self, seen: Signature) -> bool:
        """Whether a signature that is seen tells that it is this effect."""
        return self.tells and seen.name == self.signature and (not self.by or self.by in seen.details)

    @property
    def is_denied_by_absence(self) -> bool:
        """Whether the effect would have been seen where the signature is not."""
        return self.tells and self.absence


Library = Mapping[str, "type[Effect]"]
"""Effects, name to class."""


def made_by(effect: type[Effect], signature: str) -> Makes | None:
    """Return what an effect says of a signature; None where it does not make it."""
    return next((one for one in effect.signatures or () if one.signature == signature), None)


def makers_of(signature: str, library: Library) -> dict[str, Makes]:
    """Return the effects of a library that make a signature, name to what they say of it; usual ones first.

    Args:
        signature: Its name.
        library: Effects, name to class.
    """
    found = {name: one for name, effect in library.items() if (one := made_by(effect, signature))}
    return dict(sorted(found.items(), key=lambda item: not item[1].usual))


def told_by(seen: Signature, library: Library) -> tuple[str, ...]:
    """Return the effects of a library of which a signature tells that it is one of them."""
    return tuple(name for name, one in makers_of(seen.name, library).items() if one.is_told_by(seen))
