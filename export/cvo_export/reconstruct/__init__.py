"""Camera poses for recordings that have none: structure from motion by COLMAP, on the CPU.

choice      which frames of a recording to use, by motion and sharpness
recordings  the recordings, their motion, and the images of the frames used
stages      what a scene's folder holds, and for which options
pairs       which images to match
mapping     features, matches and the map, in a process of their own
model       the map as arrays in the project's conventions
similarity  similarity transformations
tags        AprilTags in the images, and their corners in the map
scale       the metric scale, from tags, a distance or known poses
report      what can be trusted
run         the whole command
"""
