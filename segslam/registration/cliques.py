"""Maximum cliques by branch and bound on bitsets.

Vertices are processed in degeneracy order, each with its later neighbours only, and pruned by core number (Rossi,
Gleich, Gebremedhin, "Parallel maximum clique algorithms with applications to network analysis", SISC 2015). Each such
neighbourhood is searched with greedy colouring as the upper bound (San Segundo, Rodriguez-Losada, Jimenez, "An exact
bit-parallel algorithm for the maximum clique problem", C&OR 2011).

Graphs are adjacency matrices as bits, which consistency graphs share.
"""

import numpy as np
from jaxtyping import Bool, UInt64

from segslam.core.kernels import kernel
from segslam.core.types import Indices

Bits = UInt64[np.ndarray, "_ _"]
"""One row per vertex: bit k of word w is 1 for an edge to vertex 64 w + k."""


def pack_rows(joined: Bool[np.ndarray, "n n"]) -> Bits:
    """The adjacency of n vertices as bits; the diagonal is cleared."""
    num = len(joined)
    padded = np.zeros((num, (num + 63) // 64 * 64), bool)
    padded[:, :num] = joined & ~np.eye(num, dtype=bool)
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)


@kernel("uint64(uint64)")
def count_bits(word):
    """Number of set bits, summed in fields of 2, 4 and 8 bits."""
    word -= (word >> np.uint64(1)) & np.uint64(0x5555555555555555)
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel("int64(uint64)")
def lowest_bit(word):
    """Position of the lowest set bit; `word` must not be 0."""
    return np.int64(count_bits((word & (~word + np.uint64(1))) - np.uint64(1)))


@kernel("int64(uint64[::1], int64[::1])")
def members(row, out):
    """Writes the positions of the set bits of `row`, ascending, to `out`, and returns their number."""
    count = 0
    for w in range(len(row)):
        word = row[w]
        while word:
            out[count] = 64 * w + lowest_bit(word)
            count += 1
            word &= word - np.uint64(1)
    return count


_FLOOR, _SIZE, _FOUND, _NODES = range(4)  # in `state`: size to exceed, size and number of found cliques, visited nodes


def maximum_cliques(adjacency: Bits, *, max_cliques: int, max_nodes: int) -> tuple[Indices, ...]:
    """Up to `max_cliques` cliques of the maximum size, each with its vertices in ascending order.

    If fewer are returned, they are all that exist, so the set does not depend on the numbering of the vertices; the
    order is deterministic. `max_nodes` limits the search for the size, and separately the listing; at least one clique
    is returned if either stops; a larger one may exist if the first does.
    """
    if len(adjacency) == 0:
        return ()
    order, core_numbers = degeneracy_order(adjacency)
    cliques, proved = _search(adjacency, order, core_numbers, 0, 1, max_nodes)
    if proved and max_cliques > 1:
        listed, _ = _search(adjacency, order, core_numbers, cliques.shape[1] - 1, max_cliques, max_nodes)
        cliques = listed if len(listed) else cliques
    return tuple(np.sort(clique) for clique in cliques)


@kernel("UniTuple(int64[::1], 2)(uint64[:, ::1])")
def degeneracy_order(adjacency):
    """Vertices in the order of repeated removal of a vertex of smallest degree; the core number of each vertex."""
    count = len(adjacency)
    neighbours = np.empty(count, np.int64)
    degree = np.empty(count, np.int64)
    for v in range(count):
        degree[v] = members(adjacency[v], neighbours)
    starts = np.zeros(count + 1, np.int64)  # start of the vertices of each degree in `order`
    for v in range(count):
        starts[degree[v] + 1] += 1
    for k in range(count):
        starts[k + 1] += starts[k]
    order, place = np.empty(count, np.int64), np.empty(count, np.int64)
    cursor = starts.copy()
    for v in range(count):
        place[v] = cursor[degree[v]]
        order[place[v]] = v
        cursor[degree[v]] += 1
    for step in range(count):
        v = order[step]
        for k in range(members(adjacency[v], neighbours)):
            u = neighbours[k]
            if degree[u] > degree[v]:  # swap u to the front of its degree, then move that front past it
                front = max(starts[degree[u]], step + 1)
                other = order[front]
                order[front], order[place[u]] = u, other
                place[other], place[u] = place[u], front
                starts[degree[u]] = front + 1
                degree[u] -= 1
    return order, degree


@kernel("uint64[:, ::1](uint64[:, ::1], int64[::1])")
def _induced(adjacency, vertices):
    """The adjacency among some vertices, renumbered in their order."""
    count = len(vertices)
    local = np.zeros((count, (count + 63) // 64), np.uint64)
    for i in range(count):
        row = adjacency[vertices[i]]
        for j in range(i):
            v = vertices[j]
            bit = (row[v >> 6] >> np.uint64(v & 63)) & np.uint64(1)
            local[i, j >> 6] |= bit << np.uint64(j & 63)
            local[j, i >> 6] |= bit << np.uint64(i & 63)
    return local


@kernel("Tuple((int64, int64[::1], int64[::1]))(uint64[:, ::1], uint64[::1], int64, int64, int64[::1], int64[::1])")
def _colour(adjacency, candidates, spare, top, branches, bounds):
    """Pushes the candidates that may start a clique of more than `spare` vertices, each with a bound of its size.

    The candidates are split into independent sets one after the other; a clique in the first k sets has at most k
    vertices. Candidates in the first `spare` sets need no branch of their own.
    """
    words = len(candidates)
    uncoloured = candidates.copy()
    colour = 0
    left = True
    while left:
        colour += 1
        left = False
        independent = uncoloured.copy()
        for w in range(words):
            while independent[w]:
                bit = lowest_bit(independent[w])
                v = 64 * w + bit
                uncoloured[w] &= ~(np.uint64(1) << np.uint64(bit))
                independent[w] &= ~(np.uint64(1) << np.uint64(bit))
                for u in range(w, words):
                    independent[u] &= ~adjacency[v, u]
                if colour > spare:
                    if top == len(branches):
                        branches, bounds = np.append(branches, branches), np.append(bounds, bounds)
                    branches[top], bounds[top] = v, colour
                    top += 1
            left |= uncoloured[w] != 0
    return top, branches, bounds


@kernel("void(int64[::1], int64[:, ::1], int64[::1])")
def _keep(clique, found, state):
    """Store a clique. With space for only one, it replaces the smaller clique and raises the floor."""
    state[_SIZE] = len(clique)
    if len(found) == 1:
        state[_FLOOR], state[_FOUND] = len(clique), 0
    for k in range(len(clique)):
        found[state[_FOUND], k] = clique[k]
    state[_FOUND] += 1


@kernel("void(uint64[:, ::1], int64, int64[::1], int64[:, ::1], int64[::1], int64)")
def _search_neighbourhood(adjacency, root, names, found, state, max_nodes):
    """Adds to `found` the cliques of `root` and some of its neighbours; `names`: their numbers in the whole graph."""
    count, words = adjacency.shape
    candidates = np.zeros((count + 1, words), np.uint64)  # by depth: vertices adjacent to all chosen so far
    for k in range(count):
        candidates[0, k >> 6] |= np.uint64(1) << np.uint64(k & 63)
    clique = np.empty(count + 1, np.int64)
    clique[0] = root
    starts = np.zeros(count + 2, np.int64)  # by depth: start of its branches on the stack
    branches, bounds = np.empty(2 * count + 1, np.int64), np.empty(2 * count + 1, np.int64)
    depth = 0
    if count == 0:
        _keep(clique[:1], found, state)
        return
    top, branches, bounds = _colour(adjacency, candidates[0], state[_FLOOR] - 1, 0, branches, bounds)
    while depth >= 0:
        if top == starts[depth] or depth + 1 + bounds[top - 1] <= state[_FLOOR]:
            top = starts[depth]
            depth -= 1
            continue
        state[_NODES] += 1
        top -= 1
        v = branches[top]
        clique[depth + 1] = names[v]
        candidates[depth, v >> 6] &= ~(np.uint64(1) << np.uint64(v & 63))
        left = np.uint64(0)
        for w in range(words):
            candidates[depth + 1, w] = candidates[depth, w] & adjacency[v, w]
            left |= candidates[depth + 1, w]
        if left:
            depth += 1
            starts[depth] = top
            top, branches, bounds = _colour(
                adjacency, candidates[depth], state[_FLOOR] - depth - 1, top, branches, bounds
            )
        elif depth + 2 > state[_FLOOR]:
            _keep(clique[: depth + 2], found, state)
        if state[_NODES] >= max_nodes or (len(found) > 1 and state[_FOUND] == len(found)):
            return


@kernel("int64[::1](uint64[:, ::1], int64)")
def _greedy_clique(adjacency, start):
    """A clique grown from one vertex; each step adds the candidate that keeps the most candidates."""
    count, words = adjacency.shape
    clique, rows = np.empty(count, np.int64), np.empty(count, np.int64)
    clique[0], size = start, 1
    candidates = adjacency[start].copy()
    num_rows = members(candidates, rows)
    while num_rows:
        best, most = rows[0], np.int64(-1)
        for k in range(num_rows):
            left = np.int64(0)
            for w in range(words):
                left += np.int64(count_bits(candidates[w] & adjacency[rows[k], w]))
            if left > most:
                best, most = rows[k], left
        clique[size] = best
        size += 1
        for w in range(words):
            candidates[w] &= adjacency[best, w]
        num_rows = members(candidates, rows)
    return clique[:size]


@kernel("Tuple((int64[:, ::1], boolean))(uint64[:, ::1], int64[::1], int64[::1], int64, int64, int64)")  # fmt: skip
def _search(adjacency, order, core_numbers, floor, room, max_nodes):
    """Cliques larger than `floor`, one per row, and whether the search was completed.

    With `room` for one, each clique found raises the floor, so the last one is a maximum clique. With room for more,
    all cliques have the size floor + 1, which must be the maximum size.
    """
    count = len(adjacency)
    found = np.empty((room, core_numbers.max() + 1), np.int64)
    state = np.array([floor, floor, 0, 0])
    if room == 1:
        _keep(_greedy_clique(adjacency, order[count - 1]), found, state)
    later = np.empty(count, np.int64)
    for step in range(count - 1, -1, -1):
        v = order[step]
        num_later = 0
        if core_numbers[v] >= state[_FLOOR]:
            for other in range(count - 1, step, -1):
                u = order[other]
                if (adjacency[v, u >> 6] >> np.uint64(u & 63)) & np.uint64(1):
                    later[num_later] = u
                    num_later += 1
        if num_later >= state[_FLOOR]:
            state[_NODES] += num_later  # cost of building this neighbourhood, in nodes
            candidates = later[:num_later]
            _search_neighbourhood(_induced(adjacency, candidates), v, candidates, found, state, max_nodes)
        if state[_NODES] >= max_nodes or (room > 1 and state[_FOUND] == room):
            break
    return found[: state[_FOUND], : state[_SIZE]].copy(), state[_NODES] < max_nodes
