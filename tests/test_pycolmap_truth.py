"""Scenes that pycolmap makes, with known truth: imported, adjusted, and the truth lies where the predicted sigmas say."""

import numpy as np
import pytest

import baarda
from baarda.formats import read
from baarda.geometry.similarity import similarity

SEEDS, NOISE = range(6), 0.7


def adjusted(pycolmap, folder, seed):
    """Make a scene, disturb image points, poses and points, write it, read it and adjust it; also its truth."""
    pycolmap.set_random_seed(seed + 1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 1, 4, 60
    options.num_points2D_without_point3D = 0
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [1280.0, 512.0, 384.0, 0.05]
    scene = pycolmap.synthesize_dataset(options)
    truth = {str(i): np.array(p.xyz) for i, p in scene.points3D.items()}
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = NOISE, 0.01
    noise.rig_from_world_translation_stddev, noise.rig_from_world_rotation_stddev = 0.01, 0.3
    pycolmap.synthesize_noise(noise, scene)
    where = folder / str(seed)
    where.mkdir()
    scene.write_text(str(where))
    result = baarda.adjust(read(where), image_sigma=NOISE)
    assert result.status == "converged"
    return result, truth


def test_coverage_of_the_truth(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="the oracle pycolmap is not installed (extra 'oracle')")
    points, cameras, factors, quadratic, freedom = [], [], [], 0.0, 0
    for seed in SEEDS:
        result, truth = adjusted(pycolmap, tmp_path, seed)
        table = result.point_table("apriori")
        at = [k for k, label in enumerate(table["point"]) if np.isfinite(table["X"][k]) and str(label) in truth]
        x = np.stack([np.asarray(table[a])[at] for a in "XYZ"], axis=1)
        s = np.stack([np.asarray(table[f"s{a}"])[at] for a in "XYZ"], axis=1)
        t = np.array([truth[str(table["point"][k])] for k in at])
        # the truth in the datum of a free network: all points meet as well as they can
        d = x - similarity(t, x).apply(t)
        points.append((d / s).ravel())
        factors.append((result.redundancy, result.variance_factor))
        names = [f"point {table['point'][k]}: {a}" for k in at for a in "XYZ"]
        q = result.covariance(names, names, sigma="apriori")
        values, vectors = np.linalg.eigh(q)
        kept = values > 1e-9 * values[-1]
        assert kept.sum() == len(names) - 7
        quadratic += float(((vectors[:, kept].T @ d.ravel()) ** 2 / values[kept]).sum())
        freedom += int(kept.sum())
        for camera in result.network.cameras:
            for name, true in (("principal_distance", 1280.0), ("k1", 0.05)):
                k = camera.model.order.index(name)
                sigma = np.sqrt(
                    np.ravel(result.covariance(f"camera {camera.label}: {name}", f"camera {camera.label}: {name}", sigma="apriori"))[0]
                )
                cameras.append((camera.values[k] - true) / sigma)
    z = np.concatenate(points)
    assert len(z) > 900
    # 95 % and 68 %; the coordinates of a block are correlated, so the bounds are wider than binomial
    assert 0.93 < np.mean(np.abs(z) < 1.96) < 0.97 and 0.63 < np.mean(np.abs(z) < 1.0) < 0.73
    # the whole vector with all its correlations: chi-square, within four of its standard deviations
    assert abs(quadratic - freedom) < 4 * np.sqrt(2 * freedom)
    assert np.sqrt(np.mean(np.square(cameras))) == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(cameras))) and np.abs(cameras).max() < 4.5
    r = np.array([f[0] for f in factors])
    pooled = np.sum(r * [f[1] for f in factors]) / r.sum()
    assert abs(pooled - 1.0) < 4 * np.sqrt(2 / r.sum())
