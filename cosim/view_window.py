"""The window of `cosim view`: play, step, slide and look around."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from cosim import interrupts
from cosim.playback import VIEWS, Playback

if TYPE_CHECKING:
    from cosim.vedo_scene import Stage

NAP_S: Final = 0.01
KEYS: Final = "space play   \u2190 \u2192 step   Home End   drag turn   wheel zoom   c camera   q quit"
QUIT: Final = ("q", "Escape")
_PLAY, _PAUSE = 0, 1


class Controls:
    """Buttons, keys and the slider of time, and what they do to a playback.

    Args:
        stage: the window.
        playback: what it shows.
        realtime: simulated over wall-clock time when it plays.
        begin: moment to begin with.
    """

    def __init__(self, stage: Stage, playback: Playback, realtime: float, begin: int = 0) -> None:
        self._stage, self._playback, self._realtime = stage, playback, realtime
        self.moment, self.playing, self.open = begin, False, True
        self._started = (0.0, 0.0)
        """Wall-clock time and simulated time at which playing began."""
        stage.on_key(self.press)
        self._slide = stage.slider(max(playback.last, 1), self._slid)
        self._play = stage.button(("Play ", "Pause"), (0.055, 0.06), self.toggle)
        stage.button(("<",), (0.128, 0.06), lambda: self.step(-1))
        stage.button((">",), (0.171, 0.06), lambda: self.step(1))
        stage.button(("View",), (0.238, 0.06), self.change_view)
        stage.text(KEYS, "bottom-left", size=0.6)
        self.go_to(begin)

    def run(self) -> None:
        """Until the window is closed."""
        while self._stage.pump() and self.open:
            interrupts.check()
            if self.playing:
                self.advance(time.monotonic())
            time.sleep(NAP_S)

    def press(self, key: str) -> None:
        """Do what a key stands for."""
        if key in QUIT:
            self.open = False
        elif key == "space":
            self.toggle()
        elif key in ("Left", "Right"):
            self.step(-1 if key == "Left" else 1)
        elif key in ("Home", "End"):
            self._pause()
            self.go_to(0 if key == "Home" else self._playback.last)
        elif key == "c":
            self.change_view()

    def toggle(self) -> None:
        """Play, from the beginning where the end is reached, or pause."""
        if self.playing:
            self._pause()
            return
        if self.moment >= self._playback.last:
            self.go_to(0)
        self.playing = True
        self._started = (time.monotonic(), self._time(self.moment))
        self._play(_PAUSE)

    def step(self, by: int) -> None:
        """Pause, and go a few records on or back."""
        self._pause()
        self.go_to(self.moment + by)

    def change_view(self) -> None:
        """Put the camera to its next place."""
        now = VIEWS.index(self._playback.view)
        self._playback.change_view(VIEWS[(now + 1) % len(VIEWS)], self.moment)
        self._stage.draw()

    def advance(self, now: float) -> None:
        """Show what is due while it plays; `now` is a time of the monotonic clock (s)."""
        began, simulated = self._started
        moment = self._playback.leader.at(simulated + (now - began) * self._realtime)
        if moment != self.moment:
            self.go_to(moment)
        if moment >= self._playback.last:
            self._pause()

    def go_to(self, moment: int) -> None:
        """Show a moment, the nearest there is."""
        self.moment = min(max(moment, 0), self._playback.last)
        self._slide(self.moment)
        self._playback.show(self.moment)
        self._stage.draw()

    def _slid(self, moment: int) -> None:
        self._pause()
        if moment != self.moment:
            self.go_to(moment)

    def _pause(self) -> None:
        self.playing = False
        self._play(_PLAY)

    def _time(self, moment: int) -> float:
        return float(self._playback.leader.scene.times[moment])


def stay_open(stage: Stage) -> None:
    """Show what stands there until the window is closed or q is pressed."""
    pressed: list[str] = []
    stage.on_key(pressed.append)
    stage.text("drag turn   wheel zoom   q quit", "bottom-left", size=0.6)
    stage.draw()
    while stage.pump() and not set(pressed) & set(QUIT):
        interrupts.check()
        time.sleep(NAP_S)
