"""Public collections of labelled sound, as manifests."""
