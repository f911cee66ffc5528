"""Corpora, error counts and pictures: what training and evaluation share."""
