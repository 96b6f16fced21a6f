#!/bin/sh
# Bundle the parts of three.js that the viewer uses into one classic script.
#     tools/bundle_three.sh        needs npm, and the network for its registry
# Versions and digests are fixed: the same bytes come out wherever it runs.
set -eu
THREE=0.187.0
ESBUILD=0.28.2
target=$(cd "$(dirname "$0")/.." && pwd)/intercap_core/output/viewer/data
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
npm pack --silent "three@$THREE" "@esbuild/linux-x64@$ESBUILD" > packed
sha256sum --check --quiet << END
ff540832ded0cfe919764d24a3d88f3e2a05f23303f876423e4f893841e90728  three-$THREE.tgz
9573bb2233aab0f9ea7647d5cca9726113cc1768de61d66b17267f4db84488f6  esbuild-linux-x64-$ESBUILD.tgz
END
mkdir -p node_modules/three esbuild
tar xzf "three-$THREE.tgz" -C node_modules/three --strip-components=1
tar xzf "esbuild-linux-x64-$ESBUILD.tgz" -C esbuild --strip-components=1
cat > entry.js << 'END'
export {
  AmbientLight, BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide,
  DynamicDrawUsage, GridHelper, Group, HemisphereLight, LineBasicMaterial, LineSegments, Matrix4,
  Mesh, MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, PlaneGeometry, Points,
  PointsMaterial, Raycaster, Scene, SRGBColorSpace, Texture, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
END
./esbuild/bin/esbuild entry.js --bundle --minify --format=iife --global-name=THREE \
    --legal-comments=none --outfile=three.min.js --log-level=warning
{ echo "/* three.js $THREE, MIT licence: see three.LICENSE.txt */"; cat three.min.js; } > "$target/three.js"
cp node_modules/three/LICENSE "$target/three.LICENSE.txt"
ls -l "$target"
