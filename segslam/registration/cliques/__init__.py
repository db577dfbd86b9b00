"""Maximum cliques, and graphs as adjacency bits."""

from segslam.registration.cliques.bits import Bits, pack_rows
from segslam.registration.cliques.search import CliqueSearch, maximum_cliques

__all__ = ["Bits", "CliqueSearch", "maximum_cliques", "pack_rows"]
