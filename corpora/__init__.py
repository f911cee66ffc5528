"""Speech corpora, clips of lips and error counts, for training and evaluation."""
