"""Calibration of the camera response from surface that photographs of different exposure share (Eq. C.17 to C.24).

The likelihood of the sensor values is maximised over the parameters of the response with the levels of the patches eliminated;
the covariance is a sandwich over clusters of one block in one view (docs/method/camera.md).
"""
