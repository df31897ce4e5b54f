#!/bin/sh
# Measure every results file, and write every page from them: `make bench`. It takes several hours on two quiet cores.
#
# A part that has finished at this commit is not repeated: the command continues where it was stopped. These variables
# name the folders of data that is not in the repository. Parts whose data is missing are left out.
#   DATA       the scenes: strecha, eth3d, colmap, matches
#   MATCHES    problems of `real_matches.py make`, in its folders seen and unseen
#   KEYPOINTS  problems of `keypoints.py`, and their sources.json
# What else the pages show was measured by `gpu.py`, and by the trainings that docs/results/make.py lists.
set -eu
cd "$(dirname "$0")/.."
PYTHON=${PYTHON:-python}
if ! git diff --quiet HEAD -- '*.py' kornia_pnpnet conf; then
    echo "Commit the changes of code first: results files name their commit."
    exit 1
fi
PARTS=outputs/measured/$(git rev-parse HEAD)
if [ ! -d "$PARTS" ]; then
    rm -rf outputs/measured outputs/results
    mkdir -p "$PARTS"
fi

part() { # part NAME SCRIPT OPTION...
    finished=$PARTS/$1
    shift
    if [ ! -e "$finished" ]; then
        echo "Measuring: $*"
        "$PYTHON" "$@"
        touch "$finished"
    fi
}

part solvers benchmarks/solvers.py --repeats 5 --out benchmarks/solvers.json
for name in latency startup throughput; do
    part $name benchmarks/performance.py measure --parts $name
done
part uncertainty benchmarks/uncertainty.py --out benchmarks/uncertainty.json
part upstream benchmarks/upstream.py --out benchmarks/upstream.json
part scale benchmarks/scale.py --problems 10000000
for name in fiducial_board incremental_map keypoint_offsets keypoint_pipeline localiser pose_network tracking; do
    part $name docs/examples/$name.py --out docs/examples
done
part package -c "from kornia_pnpnet.cli import main; raise SystemExit(main())" export outputs/set.pt2 --pairs 50 --batch 1 --overwrite
part serve docs/examples/serve.py --package outputs/set.pt2 --out docs/examples
part keypoint_covariances docs/examples/keypoint_pipeline.py --covariances --updates 600 --out docs/examples

if [ -n "${DATA:-}" ]; then
    part cameras benchmarks/cameras.py --out benchmarks/cameras.json --data "$DATA"
    part results docs/results/make.py measure --scenes "$DATA"
else
    echo "Not measured without DATA: cameras and scenes, and the tables of docs/results"
fi

if [ -n "${MATCHES:-}" ]; then
    set_="pnpnet-set pnpnet-set+ratio"
    fixed="pnpnet-set:effort=fixed pnpnet-set:effort=fixed+ratio"
    fast=min_iterations=100,max_iterations=10000
    many=min_iterations=1000,max_iterations=100000
    # Options of other libraries are chosen on the seen scenes: those that are fastest within 0.3 points of the best.
    grid=
    for pixels in 2 3 4 6 8 12; do
        for samples in $fast min_iterations=100,max_iterations=100000 $many; do
            grid="$grid poselib:threshold=$pixels,$samples"
        done
    done
    for pixels in 2 3 4 6; do
        for samples in $fast $many; do
            grid="$grid poselib:threshold=$pixels,$samples,progressive_sampling=true+ratio"
        done
    done
    for pixels in 2 3 4 6 8; do
        grid="$grid p3p-ransac:threshold=$pixels opencv-usac:threshold=$pixels"
        for loss in 1 2 4 15; do
            grid="$grid pycolmap:threshold=$pixels,loss_scale=$loss"
        done
    done
    for pixels in 2 3 4; do
        grid="$grid opencv-usac:threshold=$pixels,iterations=100000"
        for loss in 1 2; do
            grid="$grid pycolmap:threshold=$pixels,loss_scale=$loss,max_iterations=100000"
        done
    done
    part seen benchmarks/real_matches.py measure "$MATCHES"/seen/*.npz --out docs/results/real_matches_seen.json \
        --split "Seen: scenes of earlier measurements; the options of other libraries were chosen here" \
        --solvers $set_ $fixed p3p-ransac:threshold=6+ratio $grid known-inliers
    p3p="p3p-ransac:threshold=6 p3p-ransac:threshold=6+ratio"
    poselib="poselib:threshold=4,$fast poselib:threshold=3,$many"
    others="pycolmap:threshold=8,loss_scale=1,max_iterations=10000"
    others="$others pycolmap:threshold=3,loss_scale=1,max_iterations=100000 opencv-usac:threshold=2,iterations=100000"
    part unseen benchmarks/real_matches.py measure "$MATCHES"/unseen/*.npz --out docs/results/real_matches.json \
        --batch 500 1 --times 3 --pictures docs/results \
        --split "Unseen: nothing was chosen on these scenes" --solvers $set_ $fixed $p3p $poselib \
        poselib:threshold=3,$many,progressive_sampling=true+ratio $others known-inliers
    part cost benchmarks/real_matches.py cost "$MATCHES"/unseen/*.npz --out docs/results/real_matches_cost.json \
        --solvers $set_ pnpnet-set:effort=fixed $p3p $poselib $others
else
    echo "Not measured without MATCHES: docs/results/real_matches.md"
fi

if [ -n "${KEYPOINTS:-}" ]; then
    part keypoints benchmarks/keypoints.py "$KEYPOINTS"/*.npz --sources "$KEYPOINTS/sources.json" \
        --out docs/results/keypoints.json
else
    echo "Not measured without KEYPOINTS: docs/results/keypoints.json"
fi

"$PYTHON" benchmarks/performance.py render
"$PYTHON" docs/results/make.py render
"$PYTHON" docs/examples/tables.py
