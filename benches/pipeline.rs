//! How fast the stages are, and how much the results weigh: `cargo bench`. Work per second is in the `thrpt` rows.

use std::hint::black_box;
use std::path::Path;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use metromap::geometry::{Robot, Transform, World};
use metromap::image::{Capture, Image, Line, Reading};
use metromap::line::{Estimator, Extractor, LineParams};
use metromap::maps::Maps;
use metromap::optics::Rig;
use metromap::pipeline::{Pipeline, PipelineParams};
use metromap::points::profile;
use metromap::scanner::Renderer;
use metromap::sonar::{Ring, RingParams, Targets};
use metromap::sources::{Scenario, Simulation};
use metromap::time::Stamp;
use metromap::world::Surfaces;

const ESTIMATORS: [(&str, Estimator); 4] = [
    ("auto", Estimator::Auto),
    ("full fit", Estimator::FullFit),
    ("centroid", Estimator::Centroid),
    ("whole pixel", Estimator::WholePixel),
];

/// The lab, and a view of its floor with the ball, the table and the ramp in it.
struct Lab {
    scenario: Scenario,
    surfaces: Surfaces,
    renderer: Renderer,
    pose: Transform<World, Robot>,
    image: Image,
}

fn lab() -> Lab {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("worlds/lab.toml");
    let scenario = Scenario::load(&path, &[]).expect("the lab loads");
    let surfaces = Surfaces::new(&scenario.scene).expect("the lab has surfaces");
    let renderer = Renderer::new(&scenario.true_rig, scenario.image, &scenario.scene).expect("the camera is possible");
    let pose = Transform::planar(0.0, 0.6, std::f64::consts::FRAC_PI_2);
    let beam_rad = scenario.rig.beam_rad(60).expect("a pulse within the travel");
    let image = renderer.expose(&surfaces, &pose, 0.0, beam_rad, 1, 0).expect("an image").image;
    Lab { scenario, surfaces, renderer, pose, image }
}

fn stages(criterion: &mut Criterion) {
    let lab = lab();
    let rig = Rig::metro_i();
    let beam_rad = rig.beam_rad(60).expect("a pulse within the travel");
    let mut extractor = Extractor::new(lab.scenario.pipeline.line).expect("parameters are possible");
    let line = extractor.extract(&lab.image);
    let (seen, _) = profile(&rig, &line, Stamp(0), 0, 60).expect("encoders within their travel");
    let placed = seen.moved(&lab.pose);
    eprintln!(
        "one frame: {} bytes of image, {} columns with a line, {} points",
        lab.image.levels().len(),
        line.count(),
        placed.points.len()
    );

    let mut maps = Maps::new(lab.scenario.pipeline.maps).expect("parameters are possible");
    maps.insert(&placed, &lab.pose);
    let map = maps.summary().occupancy;
    eprintln!("its map: {} bytes, {} voxels occupied, {} free", map.bytes, map.occupied, map.free);

    let mut group = criterion.benchmark_group("stage");
    group.throughput(Throughput::Elements(1));
    group.bench_function("slit frame 512x480", |b| {
        let mut frame = 0;
        b.iter(|| {
            frame += 1;
            lab.renderer.expose(&lab.surfaces, &lab.pose, 0.0, black_box(beam_rad), 1, frame).expect("an image")
        });
    });
    group.bench_function("line extraction 512x480", |b| b.iter(|| extractor.extract(black_box(&lab.image))));
    for (name, estimator) in ESTIMATORS {
        let params = LineParams { estimator, ..lab.scenario.pipeline.line };
        let mut extractor = Extractor::new(params).expect("parameters are possible");
        let mut found = Line::empty();
        let name = format!("line extraction 512x480, {name}, into the same line");
        group.bench_function(name, |b| b.iter(|| extractor.extract_into(black_box(&lab.image), &mut found)));
    }
    group.bench_function("profile to points", |b| b.iter(|| profile(&rig, black_box(&line), Stamp(0), 0, 60)));
    group.bench_function("map insert", |b| {
        let mut maps = Maps::new(lab.scenario.pipeline.maps).expect("parameters are possible");
        b.iter(|| maps.insert(black_box(&placed), &lab.pose));
    });
    group.bench_function("whole step: image to maps", |b| {
        let mut pipeline = Pipeline::new(rig.clone(), PipelineParams::default()).expect("parameters are possible");
        let mut id = 0;
        b.iter(|| {
            id += 1;
            let capture = Capture {
                id,
                stamp: Stamp(id as i64),
                cylinder_pulse: 0,
                mirror_pulse: 60,
                odom_from_robot: Transform::planar(0.0, 0.6, std::f64::consts::FRAC_PI_2),
                reading: Reading::Image(lab.image.clone()),
            };
            pipeline.step(black_box(&capture)).map(|step| step.placed.points.len())
        });
    });
    group.finish();
}

fn simulation(criterion: &mut Criterion) {
    let lab = lab();
    let mut group = criterion.benchmark_group("simulation");
    group.sample_size(10);
    group.throughput(Throughput::Elements(20));
    group.bench_function("20 captures of the lab, physics and images", |b| {
        b.iter(|| {
            let mut simulation = Simulation::new(&lab.scenario).expect("the lab runs");
            (0..20).filter_map(|_| simulation.next_shot().expect("a shot")).count()
        });
    });
    group.finish();
}

fn ultrasound(criterion: &mut Criterion) {
    let lab = lab();
    let params = RingParams::default();
    let targets = Targets::new(&lab.scenario.scene).expect("the lab has surfaces");
    eprintln!(
        "ring: {} transducers, order {}, {} reflecting features in the lab",
        params.count,
        params.order,
        targets.feature_count()
    );
    let mut group = criterion.benchmark_group("ultrasound");
    // Milliseconds of run time: 200 K a second are 200 times real time.
    group.throughput(Throughput::Elements((params.ring_s() * 1e3).round() as u64));
    group.bench_function("once around the ring of 24 at order 2, in ms of run time", |b| {
        let mut ring = Ring::new(params, 1).expect("parameters are possible");
        let (mut at, mut metres) = (Stamp(0), 0.0);
        b.iter(|| {
            let mut echoes = 0;
            for _ in 0..params.count {
                // To and fro along the lane, 0.3 m/s.
                metres += 0.3 * params.interval_s;
                let x = 2.0 - (metres % 8.0 - 4.0_f64).abs();
                let pings = ring.fire(at, &Transform::planar(x, -1.0, 0.3 * x), black_box(&targets)).expect("a ping");
                echoes += pings.iter().map(|ping| ping.echoes.len()).sum::<usize>();
                at = ring.due(at);
            }
            echoes
        });
    });
    group.finish();
}

criterion_group!(benches, stages, simulation, ultrasound);
criterion_main!(benches);
