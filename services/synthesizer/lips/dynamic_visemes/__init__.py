"""Dynamic visemes (Wang & Cai 2003; Li et al. 2011), a lip model."""
