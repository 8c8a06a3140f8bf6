"""The compile cache as `mjx-cl doctor` tries it: one that works, one that cannot be written."""

import os
import sys

import pytest

from mjx_cl.io import cache_check


def test_a_second_process_finds_what_a_first_one_compiled(tmp_path, monkeypatch):
  monkeypatch.setenv("MJX_CL_CACHE", str(tmp_path / "cache"))
  assert cache_check.check() == (True, "")
  assert (tmp_path / "cache").is_dir() and not list((tmp_path / "cache").glob("*cache_check*"))
  monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "false")
  found = cache_check.check()
  assert not found.hit and "JAX_ENABLE_COMPILATION_CACHE" in found.remedy


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc")
def test_a_cache_that_cannot_be_written_is_named_with_the_remedy(tmp_path, monkeypatch):
  """A superuser may write whatever the modes are, but not to /proc."""
  folder = tmp_path / "cache"
  folder.mkdir()
  folder.chmod(0o555)
  monkeypatch.setenv("MJX_CL_CACHE", "/proc" if os.access(folder, os.W_OK) else str(folder))
  found = cache_check.check()
  assert not found.hit and "\n" not in found.remedy
  assert "cannot be written" in found.remedy and "set MJX_CL_CACHE" in found.remedy
