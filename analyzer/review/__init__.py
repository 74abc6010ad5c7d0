"""Going through a timeline: marking what was heard, span after span."""
