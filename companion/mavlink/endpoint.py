"""One link's MAVLink end: ids, sequence numbers and signatures out, messages in. Bytes only, no I/O."""

from collections.abc import Callable

from pymavlink.dialects.v20 import all as mavlink2

from drivers.mavlink_frames import MavlinkMessage, MavlinkParser, set_signing


class Endpoint:
    """Packs what we say on one link and parses what is said to us.

    Args:
        component: our component id.
        link_id: of signatures, one for each link.
        key: to sign with and to ask signatures by; None = neither.
        timestamp: gives the timestamp of the next signature.
    """

    def __init__(
        self, component: int, link_id: int, key: bytes | None, timestamp: Callable[[], int] | None
    ) -> None:
        self.component = component
        self.parser = MavlinkParser(key)
        self._packers: dict[int, mavlink2.MAVLink] = {}
        self._link_id = link_id
        self._key = key
        self._timestamp = timestamp
        self._out = bytearray()
        if timestamp is not None:
            self.parser.forget_older(timestamp())

    def send(self, message: MavlinkMessage, system: int, component: int | None = None) -> None:
        """Put a message into what goes out next.

        Args:
            message: to pack.
            system: our system id.
            component: instead of ours.
        """
        number = component or self.component
        packer = self._packers.get(number)
        if packer is None:
            packer = self._packers[number] = mavlink2.MAVLink(None, srcComponent=number)
            if self._key is not None:
                set_signing(packer, self._key)
                packer.signing.sign_outgoing = True
                packer.signing.link_id = self._link_id
        packer.srcSystem = system
        if self._timestamp is not None:
            packer.signing.timestamp = self._timestamp()
        self._out += message.pack(packer)
        packer.seq = (packer.seq + 1) % 256

    def forward(self, message: MavlinkMessage) -> None:
        """Pass on a message of somebody else as it came, signature included."""
        self._out += message.get_msgbuf()

    def take(self) -> bytes:
        """Everything that was put in since the last call."""
        data = bytes(self._out)
        self._out.clear()
        return data
