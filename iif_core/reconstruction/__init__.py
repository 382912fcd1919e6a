"""A mesh from photographs whose cameras are known: depth by plane sweep, what several views agree on, and flat walls."""
