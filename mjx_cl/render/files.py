"""Pictures with their caption, and the files that hold them: GIF, and MP4 by ffmpeg."""

import contextlib
import itertools
import os
import pathlib
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjx_cl.errors import FileError, UserError

MARK = (214, 39, 40)  # of an acting fault


def framed(image: np.ndarray, caption: str, badge: str | None = None) -> np.ndarray:
  """A picture with its caption, and with a red border and a badge where a fault acts; uint8
  (height, width, 3).
  """
  picture = Image.fromarray(image)
  draw = ImageDraw.Draw(picture)
  size, edge = max(10, picture.height // 26), max(2, picture.height // 90)
  room = picture.width - 8 * edge
  fonts = [ImageFont.load_default(s) for s in range(size, 5, -1)]
  font = lambda text: next((f for f in fonts if draw.textlength(text, font=f) <= room), fonts[-1])
  draw.text((2 * edge, 2 * edge), caption, fill=(20, 20, 20), font=font(caption))
  if badge:
    small = font(badge)
    left, top, right, bottom = draw.textbbox((0, 0), badge, font=small)
    x, y = picture.width - right - 4 * edge, picture.height - bottom - 4 * edge
    draw.rectangle(
      (x + left - edge, y + top - edge, x + right + edge, y + bottom + edge), fill=MARK
    )
    draw.text((x, y), badge, fill=(255, 255, 255), font=small)
    draw.rectangle((0, 0, picture.width - 1, picture.height - 1), outline=MARK, width=edge)
  return np.asarray(picture)


def ffmpeg() -> str:
  """Path of ffmpeg: the system's, or that of the package imageio-ffmpeg."""
  if found := shutil.which("ffmpeg"):
    return found
  try:
    import imageio_ffmpeg

    return imageio_ffmpeg.get_ffmpeg_exe()
  except (ImportError, RuntimeError):
    raise UserError("an .mp4 needs ffmpeg: pip install 'mjx-cl[video]', or name a .gif") from None


def write_gif(path: pathlib.Path, images: Iterable[np.ndarray], fps: float) -> None:
  """A GIF that repeats for ever; its clock counts in 10 ms, so that pictures may take turns: 20 and
  30 ms at 40 a second.
  """
  reduced = [Image.fromarray(x).quantize(128, dither=Image.Dither.NONE) for x in images]
  ends = [round(100 * k / fps) for k in range(len(reduced) + 1)]
  reduced[0].save(
    path,
    format="GIF",
    save_all=True,
    append_images=reduced[1:],
    duration=[10 * max(2, b - a) for a, b in itertools.pairwise(ends)],
    loop=0,
    disposal=1,
  )


def write_mp4(path: pathlib.Path, images: Iterable[np.ndarray], fps: float) -> None:
  """H.264 by ffmpeg; an odd width or height is padded to the next even one."""
  images = iter(images)
  first = next(images)
  options = (
    f"-y -loglevel error -f rawvideo -pix_fmt rgb24 -s {first.shape[1]}x{first.shape[0]} "
    f"-r {fps:.6g} -i - -vf pad=ceil(iw/2)*2:ceil(ih/2)*2 -c:v libx264 -pix_fmt yuv420p -f mp4"
  )
  command = [ffmpeg(), *options.split(), str(path)]
  with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
    assert process.stdin  # a pipe, as asked for
    with contextlib.suppress(BrokenPipeError):
      for image in itertools.chain([first], images):
        process.stdin.write(image.tobytes())
    _, words = process.communicate()
  if process.returncode:
    raise FileError(
      f"ffmpeg failed: {words.decode(errors='replace').strip() or process.returncode}"
    )


@contextlib.contextmanager
def written(
  out: os.PathLike | str,
) -> Iterator[Callable[[Iterable[np.ndarray], float], None]]:
  """write(images, fps) for a file that ends in .gif or .mp4: under another name beside it, renamed
  at the end. FileError at once where it cannot be written.
  """
  out = pathlib.Path(out)
  suffix = out.suffix.lower()
  tmp = out.with_name(f".{out.stem}.tmp{suffix}")
  write = write_gif if suffix == ".gif" else write_mp4
  try:
    tmp.touch()
  except OSError as e:
    raise FileError(f"cannot write {out}: {e.strerror or e}") from None
  try:
    yield lambda images, fps: write(tmp, images, fps)
    os.replace(tmp, out)
  finally:
    tmp.unlink(missing_ok=True)
