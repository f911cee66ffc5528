"""Training of the universal phones: a second readout of the block network, for all languages."""
