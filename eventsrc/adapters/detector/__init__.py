"""From pictures to envelopes: an object detector and an encoder of crops, both ONNX models.

A picture with its pose goes through the keyframe gate, then through the detector, whose boxes are
cut out and encoded; the envelope goes out through `eventsrc.record.robot`. It needs the extra
``[detector]``: onnxruntime and OpenCV, each imported in one module, when it is first used.
"""
