"""Robots that others built and recorded, as robots and recordings of this project: made from the files of `shared/data`,
which are not copied."""
