"""What our messages take of a serial link, against what really goes out."""

import pytest

from companion.mavlink.budget import budget_warning, bytes_per_second
from tests.companion.mavlink.flight import Flight, site


@pytest.mark.parametrize("settings", [{}, {"speed": True}, {"message": "odometry"}])
def test_the_plan_is_what_goes_out(settings: dict[str, object]) -> None:
    config = site(**settings)
    flight = Flight(config)
    flight.fly(3.0)
    flight.autopilot.heard.clear()
    flight.fly(5.0)
    sent = sum(len(message.get_msgbuf()) for _, message in flight.autopilot.heard) / 5.0
    # The autopilot here asks for no time, which the plan allows for.
    assert 0.0 <= bytes_per_second(config) - sent < 400.0


def test_a_link_that_is_too_slow_is_named_with_figures() -> None:
    slow = site(url="/dev/ttyAMA0", baud=57600, message="odometry")
    assert "57600 baud carry 5760 B/s, our messages take 79" in budget_warning(slow)
    assert "57600 baud" in budget_warning(site(url="/dev/ttyAMA0,57600", message="odometry"))
    assert budget_warning(site(url="/dev/ttyAMA0", baud=921_600, message="odometry")) == ""
    by_path = "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0"
    assert budget_warning(site(url=by_path, baud=57600, message="odometry"))
    assert budget_warning(site(url="udpout:127.0.0.1:14550", message="odometry")) == ""
    assert budget_warning(site(url="", message="odometry")) == ""


def test_signatures_count() -> None:
    plain, signed = site(), site(signing_key="key")
    assert bytes_per_second(signed) - bytes_per_second(plain) == pytest.approx(13 * 51, rel=0.01)
