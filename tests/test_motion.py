"""Tests motion vectors against points that are cast by rays and projected in float64, against known
motions of a quad, and for static surfaces, hidden points and missing frames."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import cv2
import numpy as np
import OpenEXR
import pytest

import facerender as fr
from facerender.batch import outputs as batch_outputs
from facerender.batch.outputs import camera_facts, draw
from facerender.scenes.lod import LevelOfDetail
from tests.test_alpha import card
