"""The runtime on other processors: emulated boards, and a comparison with this machine."""
