//! Maps as files for other programs: Nav2 maps (PGM + YAML), OctoMap (`.bt`), terrain as mesh (PLY) and as ASCII grid.
//! Every file appears complete or not at all: it is written beside its place and then renamed.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use super::layers_png;
use crate::fault::{Fault, Result};
use crate::maps::{BLOCK, Block, Grid, Layers, Maps, PlanView, State, Surface, TerrainMesh};

/// Cells of the ASCII grid at most.
const ASCII_CELLS_MAX: u64 = 1 << 26;
/// Levels of an OctoMap tree below its root.
const DEPTH: u32 = 16;
/// OctoMap's keys count voxels from here.
const KEY_ZERO: i64 = 1 << (DEPTH - 1);

/// Writes all maps into a directory, which is made if it is not there. Returns the names of the files.
///
/// With ultrasonic ranges, `sonar.pgm` and `fused.pgm` stand beside `map.pgm`, all three on the same cells.
///
/// An empty map is no error: its plan view has no cells, so `map.pgm` and `map.yaml` are left out.
///
/// Errors: a file that cannot be written; an occupancy grid wider than OctoMap's 65 536 voxels.
pub fn export(dir: &Path, maps: &Maps) -> Result<Vec<String>> {
    let mut files = Vec::new();
    match maps.layers() {
        // On the same cells, so that one can be laid over the other.
        Some(Layers { laser, ultrasonic, fused }) => {
            for (name, view) in [("map", laser), ("sonar", ultrasonic), ("fused", fused)] {
                files.extend(nav2_named(dir, name, &view)?);
            }
        }
        None => {
            let plan = maps.plan_view();
            files.extend(if plan.cells.is_empty() { Vec::new() } else { nav2_map(dir, &plan)? });
        }
    }
    files.push(terrain_ply(dir, &maps.surface().mesh())?);
    files.extend(terrain_asc(dir, maps.surface(), maps.terrain().params().cell_m)?);
    files.push(occupancy_bt(dir, maps.grid())?);
    Ok(files)
}

/// Writes `map.pgm` and `map.yaml` as Nav2's map server reads them: 0 occupied, 254 free, 205 unknown; the first row of
/// the image has the highest y, and `origin` is the lower left corner.
///
/// Errors: a view without cells, or whose cells are not width × height; a file that cannot be written.
pub fn nav2_map(dir: &Path, plan: &PlanView) -> Result<Vec<String>> {
    nav2_named(dir, "map", plan)
}

/// The same as `NAME.pgm` and `NAME.yaml`.
fn nav2_named(dir: &Path, name: &str, plan: &PlanView) -> Result<Vec<String>> {
    if plan.cells.is_empty() || plan.width.checked_mul(plan.height) != Some(plan.cells.len()) {
        let found = format!("{} cells for {} x {}", plan.cells.len(), plan.width, plan.height);
        return Err(Fault::new("plan view", found, "width x height cells, at least one"));
    }
    let mut image = format!("P5\n{} {}\n255\n", plan.width, plan.height).into_bytes();
    let shade = |cell: &i8| match cell {
        0 => 254,
        ..0 => 205,
        _ => 0,
    };
    plan.cells.rchunks(plan.width).for_each(|row| image.extend(row.iter().map(shade)));
    // 205 is a share of (255 − 205)/255 = 0.19608: above 0.196 it stays unknown, with Nav2's own 0.25 it would be free.
    let yaml = format!(
        "image: {name}.pgm\nmode: trinary\nresolution: {}\norigin: [{}, {}, 0.0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n",
        plan.resolution_m, plan.origin_m[0], plan.origin_m[1]
    );
    Ok(vec![write(dir, &format!("{name}.pgm"), &image)?, write(dir, &format!("{name}.yaml"), yaml.as_bytes())?])
}

/// Writes `layers.png`: laser, ultrasonic and fused layer side by side, beside the truth (100 a surface, 0 free, −1 not to be
/// judged) where it is known.
///
/// Errors: a truth of another size; a file that cannot be written.
pub fn layers_png(dir: &Path, layers: &Layers, truth: Option<&PlanView>) -> Result<String> {
    write(dir, "layers.png", &layers_png::png(layers, truth)?)
}

/// Writes `terrain.ply`: a binary little-endian triangle mesh [m].
pub fn terrain_ply(dir: &Path, mesh: &TerrainMesh) -> Result<String> {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\ncomment terrain in metres, x forward, y left, z up\nelement vertex {}\n\
         property float x\nproperty float y\nproperty float z\nelement face {}\nproperty list uchar int vertex_indices\n\
         end_header\n",
        mesh.vertices.len(),
        mesh.triangles.len()
    )
    .into_bytes();
    mesh.vertices.iter().flatten().for_each(|c| bytes.extend(c.to_le_bytes()));
    for triangle in &mesh.triangles {
        bytes.push(3);
        triangle.iter().for_each(|corner| bytes.extend(corner.to_le_bytes()));
    }
    write(dir, "terrain.ply", &bytes)
}

/// Writes `terrain.asc`: heights of the mesh [m] in an ESRI ASCII grid of square cells of `cell_m`, −9999 where there is
/// none. `None`, and no file, where the mesh is empty or the grid would have more than 64 M cells.
pub fn terrain_asc(dir: &Path, surface: &Surface, cell_m: f64) -> Result<Option<String>> {
    let mesh = surface.mesh();
    let range = |axis: usize| {
        let values = mesh.vertices.iter().map(|v| f64::from(v[axis]) / cell_m);
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), c| (low.min(c), high.max(c)));
        // Vertices are in the middle of cells.
        (low.floor() as i64, (high.floor() - low.floor() + 1.0) as u64)
    };
    let ((left, width), (bottom, height)) = (range(0), range(1));
    if mesh.triangles.is_empty() || width.saturating_mul(height) > ASCII_CELLS_MAX {
        return Ok(None);
    }
    let corner = [left, bottom].map(|c| c as f64 * cell_m);
    let mut text = format!(
        "ncols {width}\nnrows {height}\nxllcorner {}\nyllcorner {}\ncellsize {cell_m}\nNODATA_value -9999\n",
        corner[0], corner[1]
    );
    for row in (0..height).rev() {
        let y_m = (bottom as f64 + row as f64 + 0.5) * cell_m;
        for column in 0..width {
            let x_m = (left as f64 + column as f64 + 0.5) * cell_m;
            text += if column > 0 { " " } else { "" };
            text += &surface.height_at(x_m, y_m).map_or_else(|| "-9999".to_string(), |z| format!("{z:.4}"));
        }
        text += "\n";
    }
    write(dir, "terrain.asc", text.as_bytes()).map(Some)
}

/// Writes `occupancy.bt`: the maximum-likelihood occupancy as OctoMap's binary tree.
///
/// Errors: a voxel beyond the 65 536 along each axis that an OctoMap has; a file that cannot be written.
pub fn occupancy_bt(dir: &Path, grid: &Grid) -> Result<String> {
    let root = tree(&grid.blocks())?;
    let mut data = Vec::new();
    let nodes = encode(&root, &mut data);
    let mut bytes = format!(
        "# Octomap OcTree binary file\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n\
         id OcTree\nsize {nodes}\nres {}\ndata\n",
        grid.params().voxel_m
    )
    .into_bytes();
    bytes.append(&mut data);
    write(dir, "occupancy.bt", &bytes)
}

/// A node of an octree.
#[derive(Clone, Debug, Default, PartialEq)]
enum Node {
    /// Nothing is known below it.
    #[default]
    Unknown,
    /// All below it is free.
    Free,
    /// All below it is occupied.
    Occupied,
    /// Children by x + 2y + 4z, each 0 or 1 for the lower or the upper half.
    Inner(Box<[Node; 8]>),
}

impl Node {
    /// The node of eight children; children that are all free or all occupied become one.
    fn of(children: [Node; 8]) -> Self {
        match &children[0] {
            Self::Inner(_) => Self::Inner(Box::new(children)),
            first if children.iter().all(|child| child == first) => first.clone(),
            _ => Self::Inner(Box::new(children)),
        }
    }
}

/// The tree over blocks of voxels.
fn tree(blocks: &[&Block]) -> Result<Node> {
    // Blocks along each side of the tree are counted from its lower corner.
    let blocks_side = (2 * KEY_ZERO) / BLOCK as i64;
    let mut placed = Vec::with_capacity(blocks.len());
    for block in blocks {
        let place = block.key.map(|c| i64::from(c) + blocks_side / 2);
        if !place.iter().all(|c| (0..blocks_side).contains(c)) {
            let found = format!("a block of voxels at {:?}", block.key);
            let expected = format!("all within {} blocks of the origin, as OctoMap's keys reach", blocks_side / 2);
            return Err(Fault::new("occupancy grid", found, expected));
        }
        placed.push((place, *block));
    }
    let levels = DEPTH - BLOCK.trailing_zeros();
    Ok(branch(placed, levels))
}

/// The node over blocks that all lie in one cube of 2^`level` blocks.
fn branch(blocks: Vec<([i64; 3], &Block)>, level: u32) -> Node {
    if blocks.is_empty() {
        return Node::Unknown;
    }
    if level == 0 {
        return blocks.first().map_or(Node::Unknown, |(_, block)| leaves(block, [0; 3], BLOCK));
    }
    let mut parts: [Vec<_>; 8] = Default::default();
    for (place, block) in blocks {
        let half = place.map(|c| (c >> (level - 1) & 1) as usize);
        parts[half[0] + 2 * half[1] + 4 * half[2]].push((place, block));
    }
    Node::of(parts.map(|part| branch(part, level - 1)))
}

/// The node over a cube of voxels of one block.
fn leaves(block: &Block, low: [usize; 3], side: usize) -> Node {
    if side == 1 {
        return match block.column(low[0], low[1])[low[2] % BLOCK] {
            State::Unknown => Node::Unknown,
            State::Free => Node::Free,
            State::Occupied => Node::Occupied,
        };
    }
    let half = side / 2;
    Node::of(std::array::from_fn(|child| {
        leaves(block, std::array::from_fn(|axis| low[axis] + (child >> axis & 1) * half), half)
    }))
}

/// Appends a node's children, two bits each (child 0 in the lowest: 1 free, 2 occupied, 3 has children, 0 unknown), then
/// those of its children. Returns how many nodes there are, itself included.
fn encode(node: &Node, data: &mut Vec<u8>) -> u64 {
    let Node::Inner(children) = node else {
        // A root without children: only an empty tree has one here, since no map fills all 2^48 voxels.
        return u64::from(*node != Node::Unknown);
    };
    let code = |child: &Node| match child {
        Node::Unknown => 0,
        Node::Free => 1,
        Node::Occupied => 2,
        Node::Inner(_) => 3u16,
    };
    let bits = children.iter().enumerate().fold(0, |bits, (at, child)| bits | code(child) << (2 * at));
    data.extend(bits.to_le_bytes());
    let count = |child: &Node| match child {
        Node::Inner(_) => encode(child, data),
        other => u64::from(*other != Node::Unknown),
    };
    1 + children.iter().map(count).sum::<u64>()
}

/// Writes a file beside its place, then renames it: a crash leaves no half file under the name. Returns the name.
fn write(dir: &Path, name: &str, bytes: &[u8]) -> Result<String> {
    fs::create_dir_all(dir).map_err(|error| Fault::io(dir, &error))?;
    let path = dir.join(name);
    let partial: PathBuf = dir.join(format!(".{name}.{}.partial", std::process::id()));
    let written = fs::File::create(&partial).and_then(|mut file| {
        file.write_all(bytes)?;
        file.sync_all()
    });
    written.and_then(|()| fs::rename(&partial, &path)).map_err(|error| {
        let _ = fs::remove_file(&partial); // the first error is the one to report
        Fault::io(&path, &error)
    })?;
    Ok(name.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::maps::{GridParams, MapParams};
    use nalgebra::Vector3;
    use proptest::prelude::*;

    /// The header fields `size` and `res`, and the tree, of a `.bt` file.
    fn read_bt(bytes: &[u8]) -> (u64, f64, Node) {
        let mark = b"\ndata\n";
        let at = bytes.windows(mark.len()).position(|window| window == mark).unwrap();
        let header = std::str::from_utf8(&bytes[..at]).unwrap();
        assert!(header.starts_with("# Octomap OcTree binary file\n"));
        let field = |name: &str| header.lines().find_map(|line| line.strip_prefix(name)).unwrap().trim().to_string();
        let mut data = &bytes[at + mark.len()..];
        let root = if data.is_empty() { Node::Unknown } else { decode(&mut data) };
        assert!(data.is_empty(), "{} bytes left", data.len());
        (field("size").parse().unwrap(), field("res").parse().unwrap(), root)
    }

    fn decode(data: &mut &[u8]) -> Node {
        let bits = u16::from_le_bytes([data[0], data[1]]);
        *data = &data[2..];
        Node::Inner(Box::new(std::array::from_fn(|child| match bits >> (2 * child) & 3 {
            0 => Node::Unknown,
            1 => Node::Free,
            2 => Node::Occupied,
            _ => decode(data),
        })))
    }

    fn count(node: &Node) -> u64 {
        match node {
            Node::Unknown => 0,
            Node::Inner(children) => 1 + children.iter().map(count).sum::<u64>(),
            _ => 1,
        }
    }

    fn state(root: &Node, voxel: [i32; 3]) -> State {
        let key = voxel.map(|c| i64::from(c) + KEY_ZERO);
        let (mut node, mut level) = (root, DEPTH);
        loop {
            match node {
                Node::Unknown => return State::Unknown,
                Node::Free => return State::Free,
                Node::Occupied => return State::Occupied,
                Node::Inner(children) => {
                    level -= 1;
                    let half = key.map(|c| (c >> level & 1) as usize);
                    node = &children[half[0] + 2 * half[1] + 4 * half[2]];
                }
            }
        }
    }

    /// Free and occupied leaves of at least 4 voxels a side.
    fn large_leaves(node: &Node, level: u32, counts: &mut [u64; 2]) {
        match node {
            Node::Inner(children) => children.iter().for_each(|child| large_leaves(child, level - 1, counts)),
            Node::Free if level > 1 => counts[0] += 1,
            Node::Occupied if level > 1 => counts[1] += 1,
            _ => {}
        }
    }

    #[test]
    fn a_tree_of_octomap_itself_reads_and_comes_back_byte_for_byte() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../shared/data/octomap/geb079.bt");
        let Ok(bytes) = fs::read(path) else {
            eprintln!("skipped: ../shared/data is absent");
            return;
        };
        let (size, resolution_m, root) = read_bt(&bytes);
        assert_eq!((size, resolution_m), (532_566, 0.08));
        assert_eq!(count(&root), size);
        // What is large and of one kind in a corridor is the air in it, so 1 is free and 2 occupied.
        let mut leaves = [0; 2];
        large_leaves(&root, DEPTH, &mut leaves);
        eprintln!("{leaves:?}");
        assert!(leaves[0] > 20 * leaves[1], "{leaves:?}");
        let mut data = Vec::new();
        assert_eq!(encode(&root, &mut data), size);
        assert!(bytes.ends_with(&data) && data.len() > 100_000);
    }

    proptest! {
        #[test]
        fn every_voxel_comes_back_from_its_tree(
            points in prop::collection::vec(prop::array::uniform3(-3.0..3.0f64), 0..40), eye in prop::array::uniform3(-1.0..1.0f64),
        ) {
            let dir = tempfile::tempdir().unwrap();
            let mut grid = Grid::new(GridParams::default()).unwrap();
            grid.insert_points(&[Vector3::from(eye)], points.iter().map(|p| Vector3::from(*p)));
            occupancy_bt(dir.path(), &grid).unwrap();
            let (size, resolution_m, root) = read_bt(&fs::read(dir.path().join("occupancy.bt")).unwrap());
            prop_assert_eq!((size, resolution_m), (count(&root), 0.05));
            for block in grid.blocks() {
                for (x, y, z) in (0..8).flat_map(|x| (0..8).flat_map(move |y| (0..8).map(move |z| (x, y, z)))) {
                    let voxel = [block.key[0] * 8 + x, block.key[1] * 8 + y, block.key[2] * 8 + z];
                    prop_assert_eq!(state(&root, voxel), grid.state_of(voxel));
                }
            }
        }
    }

    #[test]
    fn voxels_beyond_an_octomap_are_refused() {
        let mut grid = Grid::new(GridParams { voxel_m: 0.01, ..GridParams::default() }).unwrap();
        let far = Vector3::new(400.0, 0.0, 0.0);
        grid.insert_points(&[far], [far]);
        let fault = occupancy_bt(tempfile::tempdir().unwrap().path(), &grid).unwrap_err();
        assert!(fault.to_string().contains("occupancy grid"), "{fault}");
    }

    #[test]
    fn eight_equal_children_are_one() {
        let mut grid = Grid::new(GridParams::default()).unwrap();
        let middle = |c: i32| (f64::from(c) + 0.5) * 0.05;
        for (x, y, z) in (0..4).flat_map(|x| (0..4).flat_map(move |y| (0..4).map(move |z| (x, y, z)))) {
            grid.insert_points(&[], [Vector3::new(middle(x), middle(y), middle(z))]);
        }
        let root = tree(&grid.blocks()).unwrap();
        assert_eq!(count(&root), 15); // levels 16 to 3, and one leaf of 4 x 4 x 4 voxels
    }

    #[test]
    fn nav2_has_its_rows_from_the_top_and_unknown_stays_unknown() {
        let dir = tempfile::tempdir().unwrap();
        let cells = vec![0, 100, -1, -1, 0, 100];
        let plan = PlanView { resolution_m: 0.05, origin_m: [-1.5, 2.0], width: 3, height: 2, cells };
        assert_eq!(nav2_map(dir.path(), &plan).unwrap(), ["map.pgm", "map.yaml"]);
        let image = fs::read(dir.path().join("map.pgm")).unwrap();
        assert_eq!(image, b"P5\n3 2\n255\n\xcd\xfe\x00\xfe\x00\xcd");
        let yaml = fs::read_to_string(dir.path().join("map.yaml")).unwrap();
        assert!(yaml.contains("origin: [-1.5, 2, 0.0]\n") && yaml.contains("resolution: 0.05\n"), "{yaml}");
        // As Nav2 reads it: occ = (255 − shade)/255, above 0.65 occupied, below 0.196 free.
        let read = |shade: u8| match f64::from(255 - shade) / 255.0 {
            occ if occ > 0.65 => 100,
            occ if occ < 0.196 => 0,
            _ => -1,
        };
        let pixels: Vec<i8> = image[image.len() - 6..].iter().map(|shade| read(*shade)).collect();
        assert_eq!([&pixels[3..], &pixels[..3]].concat(), plan.cells);
        assert!(nav2_map(dir.path(), &PlanView { width: 4, ..plan.clone() }).is_err());
        assert!(nav2_map(dir.path(), &PlanView { width: 0, height: 0, cells: vec![], ..plan }).is_err());
    }

    #[test]
    fn a_mesh_has_the_bytes_its_header_says() {
        let dir = tempfile::tempdir().unwrap();
        let mesh =
            TerrainMesh { vertices: vec![[0.0; 3], [1.0, 0.0, 0.5], [0.0, 1.0, -0.5]], triangles: vec![[0, 1, 2]] };
        terrain_ply(dir.path(), &mesh).unwrap();
        let bytes = fs::read(dir.path().join("terrain.ply")).unwrap();
        let end = b"end_header\n";
        let at = bytes.windows(end.len()).position(|window| window == end).unwrap() + end.len();
        let header = std::str::from_utf8(&bytes[..at]).unwrap();
        assert!(header.contains("element vertex 3\n") && header.contains("element face 1\n"));
        assert_eq!(bytes.len() - at, 3 * 12 + 13);
        assert_eq!(bytes[at + 12..at + 16], 1.0f32.to_le_bytes());
        assert_eq!(bytes[at + 36..], [3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    }

    /// Maps of a floor at 0.1 m that is seen from x = 1 to 2 m and y = 0 to 0.5 m.
    fn some_maps() -> Maps {
        let mut maps = Maps::new(MapParams::default()).unwrap();
        let row =
            |x: u32| (0..100).map(move |y| [1.0 + f64::from(x) * 0.01 + 0.005, f64::from(y) * 0.005 + 0.002, 0.1]);
        let points: Vec<[f64; 3]> = (0..100).flat_map(row).collect();
        maps.insert(
            &crate::maps::tests::profile([0.0, 0.0, 1.0], [0.0, 0.0, 0.8], &points),
            &crate::geometry::Transform::from_xyz_rpy([0.0, 0.0, 0.1], [0.0; 3]),
        );
        maps
    }

    #[test]
    fn all_maps_are_written_whole_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("deep/er");
        let files = export(&out, &some_maps()).unwrap();
        assert_eq!(files, ["map.pgm", "map.yaml", "terrain.ply", "terrain.asc", "occupancy.bt"]);
        assert_eq!(export(&out, &some_maps()).unwrap(), files); // over the old ones
        assert_eq!(fs::read_dir(&out).unwrap().count(), files.len());
        let grid = fs::read_to_string(out.join("terrain.asc")).unwrap();
        assert!(
            grid.starts_with("ncols 20\nnrows 10\nxllcorner 1\nyllcorner 0\ncellsize 0.05\nNODATA_value -9999\n"),
            "{grid}"
        );
        let heights: Vec<&str> = grid.lines().skip(6).flat_map(|line| line.split(' ')).collect();
        assert_eq!(heights, ["0.1000"; 200]);
        let empty = export(&dir.path().join("empty"), &Maps::new(MapParams::default()).unwrap()).unwrap();
        assert_eq!(empty, ["terrain.ply", "occupancy.bt"]);
    }

    #[test]
    fn a_place_that_cannot_be_written_is_an_error_with_its_name() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        fs::write(&file, "x").unwrap();
        assert!(export(&file, &some_maps()).unwrap_err().to_string().contains("file"));
        fs::create_dir_all(dir.path().join("map.pgm")).unwrap(); // a directory is in the way of the rename
        let fault = export(dir.path(), &some_maps()).unwrap_err();
        assert!(fault.to_string().contains("map.pgm"), "{fault}");
        let left: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(left.len(), 2, "{left:?}");
    }
}
