"""Messages of ROS 2: from detections, transforms and poses to envelopes.

`assembler` makes envelopes of decoded messages, without a clock or any I/O; `transforms` is the
tree of frames over time, `messages` reads the fields. `library` decodes messages and opens bags; it
alone imports rosbags, of the extra ``[ros]``.
"""
