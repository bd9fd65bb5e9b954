"""Run folders as pages: one HTML file that needs no other, for a run or for several beside each other.

What stands in the files of a run folder, names of images above all, may be anything: it is data, and is escaped.
"""
