"""kouxing: live speech in, a talking 3-D face out.

The links in this folder map the repository's top-level folders to one import package.
"""
