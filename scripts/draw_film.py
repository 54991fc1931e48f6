"""Draw the film of the README: docs/images/filter.gif and docs/images/filter.mp4, at most 4 MB each.

`MUJOCO_GL=egl python -m scripts.draw_film docs/images` runs the motion of `filter_demo.py` twice, without and with the
safety filter, and puts both side by side, in real time. The curve below is the true distance between the robot's
collision spheres and the arm of the person; below zero they touch.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dualbrain.simulation.perception.rendering import Camera
from scripts.filter_demo import DURATION_S, open_demo_world, run_demo

FRAMES_PER_SECOND = 12
RENDER_SIZE, CROP, VIEW_SIZE = (800, 600), (130, 60, 730, 510), (400, 300)
"""Size of the rendered image, part of it that is shown, and size of that part in the film [pixels]."""
HEAD_HEIGHT, CURVE_HEIGHT, GAP = 40, 130, 4
FIRST_S = 1.5
"""Start of the film in the run [s]."""
MAX_DISTANCE_M, MIN_DISTANCE_M = 0.30, -0.03
"""Upper and lower end of the curve [m]; larger distances are drawn at the upper end."""
RED, BLUE, DARK, GREY, LIGHT = (196, 36, 30), (20, 110, 200), (28, 33, 39), (140, 148, 156), (244, 245, 246)
GIF_COLOURS = 128
MAX_BYTES = 4_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """One frame of one run: image, time [s], true distance [m] to the person, share of the speed that remains."""

    image: Image.Image
    t: float
    distance: float
    speed_share: float


def take_shots(*, guard: bool) -> list[Shot]:
    """The frames of the run without or with the filter."""
    world, shots = open_demo_world(), list[Shot]()
    with Camera(world.plant, width=RENDER_SIZE[0], height=RENDER_SIZE[1], shadows=True) as camera:
        for tick in run_demo(world, guard=guard):
            t = tick.state.stamp
            if t < FIRST_S + len(shots) / FRAMES_PER_SECOND:
                continue
            image = Image.fromarray(camera.capture()).crop(CROP).resize(VIEW_SIZE, Image.Resampling.LANCZOS)
            wanted = max(float(np.linalg.norm(tick.result.u_nom)), 1e-9)
            share = min(1.0, float(np.linalg.norm(tick.result.u)) / wanted)
            shots.append(Shot(image=image, t=t, distance=tick.distance, speed_share=share))
    return shots


def compose(bare: list[Shot], filtered: list[Shot], k: int) -> Image.Image:
    """Frame `k` of the film: both runs with their captions, and the curves up to this moment."""
    width = 2 * VIEW_SIZE[0] + GAP
    frame = Image.new("RGB", (width, HEAD_HEIGHT + VIEW_SIZE[1] + CURVE_HEIGHT), "white")
    draw = ImageDraw.Draw(frame)
    for x, shot, name, colour in (
        (0, bare[k], "without the filter", RED),
        (VIEW_SIZE[0] + GAP, filtered[k], "with the filter", BLUE),
    ):
        frame.paste(shot.image, (x, HEAD_HEIGHT))
        touches = shot.distance < 0.0
        draw.rectangle((x, 0, x + VIEW_SIZE[0], HEAD_HEIGHT - 1), fill=RED if touches else LIGHT)
        letters = "white" if touches else colour
        draw.text((x + 12, 8), name, fill=letters, font=ImageFont.load_default(20))
        words = "COLLISION" if touches else f"{1e3 * shot.distance:.0f} mm"
        draw.text((x + VIEW_SIZE[0] - 12, 8), words, fill=letters, font=ImageFont.load_default(20), anchor="ra")
    _draw_curves(draw, bare, filtered, k, HEAD_HEIGHT + VIEW_SIZE[1])
    return frame


def _draw_curves(draw: ImageDraw.ImageDraw, bare: list[Shot], filtered: list[Shot], k: int, top: int) -> None:
    """The distances of both runs over time, below `top` [pixels]."""
    left, right = 70, 2 * VIEW_SIZE[0] + GAP - 16
    low, high = top + CURVE_HEIGHT - 22, top + 26
    font = ImageFont.load_default(13)

    def point(t: float, distance: float) -> tuple[float, float]:
        share = (t - FIRST_S) / (DURATION_S - FIRST_S)
        level = (np.clip(distance, MIN_DISTANCE_M, MAX_DISTANCE_M) - MIN_DISTANCE_M) / (MAX_DISTANCE_M - MIN_DISTANCE_M)
        return left + share * (right - left), low - level * (low - high)

    draw.text((left, top + 6), "distance between robot and person [mm]", fill=DARK, font=font)
    for distance in (0.0, 0.1, 0.2, 0.3):
        y = point(FIRST_S, distance)[1]
        draw.line((left, y, right, y), fill=DARK if distance == 0.0 else (222, 225, 228), width=1)
        draw.text((left - 8, y), f"{1e3 * distance:.0f}", fill=GREY, font=font, anchor="rm")
    for second in range(2, round(DURATION_S) + 1, 2):
        draw.text((point(second, 0.0)[0], low + 4), f"{second} s", fill=GREY, font=font, anchor="ma")
    for shots, colour in ((bare, RED), (filtered, BLUE)):
        points = [point(shot.t, shot.distance) for shot in shots[: k + 1]]
        if len(points) > 1:
            draw.line(points, fill=colour, width=3, joint="curve")
        x, y = points[-1]
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=colour)


def save_gif(frames: list[Image.Image], path: Path) -> None:
    """Save the frames as an endless animation with one palette."""
    sample = frames[:: max(1, len(frames) // 8)]
    column = Image.new("RGB", (sample[0].width, sum(frame.height for frame in sample)))
    for i, frame in enumerate(sample):
        column.paste(frame, (0, i * frame.height))
    palette = column.quantize(GIF_COLOURS)
    reduced = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    pause = [round(1000 / FRAMES_PER_SECOND)] * (len(frames) - 1) + [1500]
    reduced[0].save(path, save_all=True, append_images=reduced[1:], duration=pause, loop=0, optimize=True)


def save_mp4(frames: list[Image.Image], path: Path) -> None:
    """Save the frames as H.264, which every browser plays."""
    import imageio_ffmpeg  # noqa: PLC0415  (only for the film)

    width, height = frames[0].width // 2 * 2, frames[0].height // 2 * 2
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=FRAMES_PER_SECOND, quality=8, macro_block_size=2, codec="libx264"
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(np.asarray(frame)[:height, :width]).tobytes())
    writer.close()


def main(folder: Path) -> None:
    """Write both files."""
    bare, filtered = take_shots(guard=False), take_shots(guard=True)
    frames = [compose(bare, filtered, k) for k in range(min(len(bare), len(filtered)))]
    for save, path in ((save_gif, folder / "filter.gif"), (save_mp4, folder / "filter.mp4")):
        save(frames, path)
        size = path.stat().st_size
        print(f"{path}: {len(frames)} frames, {size / 1e6:.2f} MB")
        if size > MAX_BYTES:
            sys.exit(f"{path} is larger than {MAX_BYTES / 1e6:.0f} MB; reduce VIEW_SIZE or FRAMES_PER_SECOND.")
    least = [1e3 * min(shot.distance for shot in shots) for shots in (bare, filtered)]
    print(f"least distance: without the filter {least[0]:.1f} mm, with it {least[1]:.1f} mm")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
