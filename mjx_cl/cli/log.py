"""The command detect: a log of one's own."""

import sys

from mjx_cl.cli.flags import Detect
from mjx_cl.cli.output import emit, say
from mjx_cl.cli.tables import show_detections, show_verdict
from mjx_cl.config import settings
from mjx_cl.errors import ChangeError, FileError, require
from mjx_cl.logs import detect, results


def do_detect(args: Detect) -> None:
  """Watches a log."""
  require(
    not (args.fail_on_change and args.detector),
    "--fail-on-change goes by the verdict of the charts; leave out --detector",
  )
  out = None if args.out is None else results.claim(args.out, args.overwrite)
  result = detect.detect(
    args.file,
    args.nominal,
    args.column,
    args.detector,
    args.arl0,
    args.rate,
    args.logarithm,
    settings(args.set),
    say if sys.stderr.isatty() else lambda text: None,
    args.model,
    args.refractory,
    args.inject,
    args.command,
  )
  if out:
    results.write(result, out)
  for note in result.summary["notes"]:
    say(f"note: {note}")
  if args.json:
    emit(result.summary)
  else:
    if "verdict" in result.summary:
      show_verdict(result.summary)
    else:
      show_detections(result.summary["detectors"])
  reasons: dict[str, list[str]] = {}
  for name, why in result.summary.get("unjudged", {}).items():
    reasons.setdefault(why, []).append(name)
  columns = "; ".join(f"{', '.join(names)} ({why})" for why, names in reasons.items())
  text = f"could not be judged: {columns}"
  if args.fail_on_change and result.summary["verdict"]["changed"]:
    if columns:
      say(f"note: {text}")
    raise ChangeError("the log has changed")
  if args.fail_on_change and (gone := result.summary["ended"]):
    raise ChangeError(f"the log ends without samples of {', '.join(gone)}")
  if columns:
    raise FileError(text)
