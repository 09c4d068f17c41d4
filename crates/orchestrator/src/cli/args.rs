//! What can be typed.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::builder::Resettable;
use clap::{Arg, Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};

use crate::bench::BenchGps;
use crate::config::Config;
use crate::dataset::{CameraBook, GeoSource};
use crate::locating::Mode;
use crate::print;
use crate::session::{Limits, Session, cache_folder, stop_on_signal};
use crate::store::refuses_writes;

/// Localizes photos in a place that street-view panoramas have mapped.
#[derive(Debug, Parser)]
#[command(name = "setloc", version, max_term_width = 110)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What was typed, the program's name first.
///
/// # Errors
/// What is wrong about it, in clap's words.
pub fn parse(typed: impl IntoIterator<Item = OsString>) -> Result<Cli, clap::Error> {
    let mut command = without_empty_variables(Cli::command());
    let mut matches = command.try_get_matches_from_mut(typed)?;
    Cli::from_arg_matches_mut(&mut matches).map_err(|error| error.format(&mut command))
}

/// The command without environment variables that are set to nothing, which is how some shells and services unset them.
fn without_empty_variables(command: clap::Command) -> clap::Command {
    let is_empty = |arg: &Arg| arg.get_env().and_then(std::env::var_os).is_some_and(|value| value.is_empty());
    let without = |arg: Arg| if is_empty(&arg) { arg.env(Resettable::Reset) } else { arg };
    command.mut_args(without).mut_subcommands(without_empty_variables)
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Render the sample town, build its scene, locate its photo set and compare with the truth
    Demo(DemoArgs),
    /// Build a scene from panoramas (or photos)
    Build(BuildArgs),
    /// Show what `build` would run, and why
    Plan(PlanArgs),
    /// Locate photos in a scene
    Locate(LocateArgs),
    /// Build and locate data sets and compare with their truth
    Bench(BenchArgs),
    /// Compare poses, ours or other programs', with the truth
    Compare(CompareArgs),
    /// Build many scenes and locate many sets, from a manifest
    Batch(BatchArgs),
    /// Show what a build or a localization came to, as text and as a page
    Report(ReportArgs),
    /// Show what is stored and what the last runs did
    Status(StatusArgs),
    /// Write a scene, or the photos localized in it, in another format
    Export(ExportArgs),
    /// Make cameras.json and truth.json of a COLMAP model, binary or text
    Import(ImportArgs),
    /// Say what changed for a job or image between the last two runs
    Explain(ExplainArgs),
    /// Look after the store of results
    Cache(CacheArgs),
}

/// Options of every command that runs jobs.
#[derive(Debug, Clone, Args)]
pub struct RunArgs {
    /// Configuration file (TOML); see --print-config
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Set one parameter, as `two_view.min_inliers=30`; overrides the file
    #[arg(long = "set", value_name = "STAGE.KEY=VALUE")]
    pub settings: Vec<String>,
    /// Seed of everything random
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Most jobs at once [default: all cores]
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// Memory for the jobs' work, as `8GiB` [default: three quarters of the machine's]
    #[arg(long, value_parser = parse_bytes)]
    pub memory: Option<u64>,
    /// Folder of stored results [default: `.setloc-cache` beside the output; of `locate` beside the scene, or beside the output
    /// where that cannot be written]
    #[arg(long, value_name = "DIR", env = "SETLOC_CACHE")]
    pub cache: Option<PathBuf>,
}

impl RunArgs {
    /// The configuration.
    pub fn config(&self) -> Result<Config> {
        Config::resolve(self.config.as_deref(), &self.settings)
    }

    /// Beside which of the two the store is where no option says: beside the other where it cannot be written beside the first.
    pub fn kept_beside<'p>(&self, first: &'p Path, other: &'p Path) -> &'p Path {
        let [folder, kept] = [first, other].map(|output| cache_folder(None, output));
        if self.cache.is_some() || folder == kept || !refuses_writes(&folder) {
            return first;
        }
        print::note(&format!(
            "note: {} cannot be written: results are kept in {}",
            folder.display(),
            kept.display()
        ));
        other
    }

    /// Opens the store; the log is a file in `log_folder`.
    pub fn session(&self, output: &Path, log_folder: Option<&Path>) -> Result<Session> {
        let all_cores = || std::thread::available_parallelism().map_or(1, usize::from);
        let threads = self.threads.map_or_else(all_cores, usize::from);
        // A pool that exists already, as in a batch, is kept.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
        let limits = Limits {
            threads,
            memory: self.memory.unwrap_or_else(|| crate::clock::physical_memory() / 4 * 3),
        };
        if let Some(folder) = log_folder {
            crate::store::create_folder(folder)?;
            crate::store::remove_leftovers(folder);
        }
        let log = log_folder.map(|folder| folder.join("run.jsonl"));
        Session::open(&cache_folder(self.cache.as_deref(), output), log.as_deref(), limits, stop_on_signal())
    }
}

/// What the scene is built from.
#[derive(Debug, Clone, Args)]
pub struct SourceArgs {
    /// Folders with images, or image files
    pub panoramas: Vec<PathBuf>,
    /// The scene file to write
    #[arg(short, long, default_value = "scene.setloc")]
    pub output: PathBuf,
    /// Positions: a table `name,lat,lon,alt`, or `exif`
    #[arg(long, value_name = "geo.csv|exif")]
    pub gps: Option<String>,
    /// Folder of mask images, named as the images, in their folders or not; black is left out
    #[arg(long, value_name = "DIR")]
    pub masks: Option<PathBuf>,
    /// Known intrinsics
    #[arg(long, value_name = "cameras.json")]
    pub cameras: Option<PathBuf>,
    /// Options of the run
    #[command(flatten)]
    pub run: RunArgs,
}

impl SourceArgs {
    /// Where positions come from.
    pub fn geo(&self) -> GeoSource {
        match self.gps.as_deref() {
            None => GeoSource::None,
            Some("exif") => GeoSource::Exif,
            Some(path) => GeoSource::Table(path.into()),
        }
    }

    /// Known intrinsics.
    pub fn camera_book(&self) -> Result<CameraBook> {
        Ok(self.cameras.as_deref().map(CameraBook::read).transpose()?.unwrap_or_default())
    }
}

/// `setloc build`
#[derive(Debug, Clone, Args)]
pub struct BuildArgs {
    /// What from
    #[command(flatten)]
    pub source: SourceArgs,
    /// Folder for poses, point cloud, COLMAP model, picture and log [default: the output without its ending]
    #[arg(long, value_name = "DIR")]
    pub export: Option<PathBuf>,
    /// Print the resolved configuration and stop
    #[arg(long)]
    pub print_config: bool,
}

/// `setloc plan`
#[derive(Debug, Clone, Args)]
pub struct PlanArgs {
    /// What from
    #[command(flatten)]
    pub source: SourceArgs,
    /// How to print it
    #[arg(long, value_enum, default_value_t)]
    pub format: PlanFormat,
}

/// How a plan is printed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ValueEnum)]
pub enum PlanFormat {
    /// For people
    #[default]
    Text,
    /// For programs
    Json,
    /// For Graphviz
    Dot,
}

/// `setloc locate`
#[derive(Debug, Clone, Args)]
pub struct LocateArgs {
    /// The scene
    pub scene: PathBuf,
    /// Folders with photos, or photo files: one set
    #[arg(required = true)]
    pub photos: Vec<PathBuf>,
    /// The photo that matters [default: the last by name]
    #[arg(long)]
    pub target: Option<String>,
    /// Methods to try
    #[arg(long, value_enum, default_value_t)]
    pub mode: Mode,
    /// Folder of mask images, named as the photos, in their folders or not; black is left out
    #[arg(long, value_name = "DIR")]
    pub masks: Option<PathBuf>,
    /// Known intrinsics
    #[arg(long, value_name = "cameras.json")]
    pub cameras: Option<PathBuf>,
    /// Also write the scene grown by the photos that are localized; each is tried alone and the set
    #[arg(long, value_name = "grown.setloc")]
    pub grow: Option<PathBuf>,
    /// Folder for the results
    #[arg(short, long, default_value = "out")]
    pub output: PathBuf,
    /// Options of the run
    #[command(flatten)]
    pub run: RunArgs,
}

/// `setloc bench`
#[derive(Debug, Clone, Args)]
pub struct BenchArgs {
    /// Data sets [default: those of the registry]
    pub datasets: Vec<PathBuf>,
    /// Folder for the results
    #[arg(short, long, default_value = "out")]
    pub output: PathBuf,
    /// Positions given to the scene; the registry has its own for each data set
    #[arg(long, value_enum, default_value_t)]
    pub gps: BenchGps,
    /// Runs with as many seeds, from --seed on
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub repeats: u64,
    /// Do not compare photos of data sets without truth with a reconstruction of scene and photos together
    #[arg(long)]
    pub no_joint_reference: bool,
    /// Options of the run; without --cache nothing is reused, so that times are those of the whole work
    #[command(flatten)]
    pub run: RunArgs,
    /// What is registered and how
    #[command(flatten)]
    pub registry: RegistryArgs,
}

/// The registry of data sets, used when no data set is named.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Registry")]
pub struct RegistryArgs {
    /// Data sets and parameter sets (TOML)
    #[arg(long, value_name = "FILE", default_value = "benchmarks/datasets.toml")]
    pub registry: PathBuf,
    /// Folder that the registry's paths are relative to [default: the registry's own]
    #[arg(long, value_name = "DIR", env = "SETLOC_DATA")]
    pub data: Option<PathBuf>,
    /// Only these of the registered data sets
    #[arg(long, value_name = "NAME", num_args = 1.., conflicts_with = "datasets")]
    pub only: Vec<String>,
    /// Figures to compare with [default: baseline.json beside the registry]
    #[arg(long, value_name = "FILE", conflicts_with = "datasets")]
    pub baseline: Option<PathBuf>,
    /// Put the figures of this run into the baseline
    #[arg(long, conflicts_with = "datasets")]
    pub update_baseline: bool,
}

/// `setloc compare`
#[derive(Debug, Clone, Args)]
pub struct CompareArgs {
    /// True poses, in any of these forms; images are known by name or by the end of it
    pub truth: PathBuf,
    /// Of each program a truth.json, a poses.json of `build`, `locate` or `bench` (or a folder that has one), a COLMAP model's
    /// folder, or lines of name and camera-from-world pose (qw qx qy qz tx ty tz)
    #[arg(required = true)]
    pub poses: Vec<PathBuf>,
    /// Align by the images whose true name starts so, as `panoramas/`, and judge the others [default: by all, and judge all]
    #[arg(long, value_name = "PREFIX", conflicts_with = "no_align")]
    pub align_by: Option<String>,
    /// Poses are in the truth's frame, or both east, north, up about a `geo_origin` that each states
    #[arg(long)]
    pub no_align: bool,
    /// File for all figures and each image's errors (JSON)
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
}

/// `setloc batch`
#[derive(Debug, Clone, Args)]
pub struct BatchArgs {
    /// The manifest (TOML)
    pub manifest: PathBuf,
    /// Folder for the results
    #[arg(short, long, default_value = "out")]
    pub output: PathBuf,
    /// Options of the run
    #[command(flatten)]
    pub run: RunArgs,
}

/// `setloc demo`
#[derive(Debug, Clone, Args)]
pub struct DemoArgs {
    /// Folder for the town and the results
    #[arg(short, long, default_value = "out/demo")]
    pub output: PathBuf,
    /// Options of the run
    #[command(flatten)]
    pub run: RunArgs,
}

/// `setloc export`
#[derive(Debug, Clone, Args)]
pub struct ExportArgs {
    /// The scene; or the folder of `locate`, of whose localized photos there are `geojson`, `kml` and `json`
    pub scene: PathBuf,
    /// The format
    #[arg(long, value_enum)]
    pub format: ExportFormat,
    /// Which component, 1 being the largest; `json` has all, `geojson` and `kml` all that are placed on the map
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub component: usize,
    /// File, or folder for COLMAP [default: standard output]
    #[arg(short, long)]
    pub output: Option<PathBuf>,
    /// Folder of stored results, for the 2D points of a COLMAP model [default: `.setloc-cache` beside the scene]
    #[arg(long, value_name = "DIR", env = "SETLOC_CACHE")]
    pub cache: Option<PathBuf>,
}

/// Formats of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ExportFormat {
    /// COLMAP's binary model (a folder)
    Colmap,
    /// Point cloud
    Ply,
    /// nerfstudio's transforms.json
    Nerfstudio,
    /// Camera positions on the map
    Geojson,
    /// The same as placemarks, for globes
    Kml,
    /// All poses
    Json,
    /// Picture from above (PNG)
    TopView,
}

/// `setloc report`
#[derive(Debug, Clone, Args)]
pub struct ReportArgs {
    /// Results of `build` (the scene file or the folder beside it) or of `locate` (its folder)
    pub results: PathBuf,
    /// The page to write [default: report.html in the folder]
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
}

/// `setloc status`
#[derive(Debug, Clone, Args)]
pub struct StatusArgs {
    /// Folder of stored results
    #[arg(long, value_name = "DIR", env = "SETLOC_CACHE", default_value = ".setloc-cache")]
    pub cache: PathBuf,
}

/// `setloc import`
#[derive(Debug, Clone, Args)]
pub struct ImportArgs {
    /// Folder with cameras.bin and images.bin, or the same as .txt
    pub model: PathBuf,
    /// Folder for cameras.json (for --cameras) and truth.json (for `bench`)
    #[arg(short, long, default_value = "out")]
    pub output: PathBuf,
    /// Put before the images' names, as `panoramas/`
    #[arg(long, default_value = "")]
    pub prefix: String,
}

/// `setloc explain`
#[derive(Debug, Clone, Args)]
pub struct ExplainArgs {
    /// A job as `features panoramas/a.jpg`, or a part of its name
    pub job: String,
    /// Folder of stored results
    #[arg(long, value_name = "DIR", env = "SETLOC_CACHE", default_value = ".setloc-cache")]
    pub cache: PathBuf,
}

/// `setloc cache`
#[derive(Debug, Clone, Args)]
pub struct CacheArgs {
    /// What to do
    #[command(subcommand)]
    pub command: CacheCommand,
    /// Folder of stored results
    #[arg(long, global = true, value_name = "DIR", env = "SETLOC_CACHE", default_value = ".setloc-cache")]
    pub cache: PathBuf,
}

/// `setloc cache …`
#[derive(Debug, Clone, Subcommand)]
pub enum CacheCommand {
    /// Count and size by kind
    Ls,
    /// Remove what the last runs do not use
    Gc {
        /// Also remove the oldest results until at most this is left, as `5GiB`; what is younger than --min-age stays
        #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
        max: Option<u64>,
        /// Leave what is younger, in minutes: it may belong to a run that goes on
        #[arg(long, value_name = "MINUTES", default_value_t = 60)]
        min_age: u64,
    },
    /// Check every stored result; damaged ones are removed
    Verify,
}

/// `8GiB`, `500MB`, `1024B`: a number alone could be meant in any unit.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match text[digits.len()..].to_ascii_lowercase().as_str() {
        "" => return Err(format!("`{text}` has no unit: write it as 8GiB, 500MB or 1024B")),
        "b" => 1,
        "k" | "kib" => 1 << 10,
        "kb" => 1000,
        "m" | "mib" => 1 << 20,
        "mb" => 1_000_000,
        "g" | "gib" => 1 << 30,
        "gb" => 1_000_000_000,
        other => return Err(format!("unknown unit `{other}`: use MiB, GiB, MB or GB")),
    };
    let number: f64 = digits.trim().parse().map_err(|_| format!("`{text}` is no size: write it as 8GiB"))?;
    if number > 0.0 { Ok((number * unit as f64) as u64) } else { Err("must be more than 0".to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn sizes_are_read_with_their_unit() {
        assert_eq!(parse_bytes("8GiB").unwrap(), 8 << 30);
        assert_eq!(parse_bytes("1.5MB").unwrap(), 1_500_000);
        assert_eq!(parse_bytes("1024B").unwrap(), 1024);
        assert!(parse_bytes("8 apples").is_err() && parse_bytes("-1GiB").is_err());
        assert!(parse_bytes("5").unwrap_err().contains("`5` has no unit"));
    }
}
