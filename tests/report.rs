//! Pages and figures, opened as their readers would.

mod common;

use phantom::report::{Chart, Line, Report, ReportError, Section, Table};

/// Text that would do harm where it is not escaped.
const HOSTILE: &str = "</script><script>document.title='broken'</script><img src=x> & \"q\"";

fn chart(title: &str) -> Chart {
    let x: Vec<f64> = (0..9000).map(|i| f64::from(i) * 1e-3).collect();
    let measured = x.iter().map(|t| (3.0 * t).sin()).collect();
    let mut model: Vec<f64> = x.iter().map(|t| (3.0 * t).cos()).collect();
    model[500..900].fill(f64::NAN);
    Chart::new(title, "time (s)", "force (N)", x)
        .series("measured", Line::Solid, measured)
        .series(HOSTILE, Line::Dashed, model)
}

fn report() -> Report {
    let mut table = Table::new(HOSTILE, &["joint", HOSTILE]);
    table.push(vec![HOSTILE.into(), "1.5".into()]);
    let positive = vec![0.0, 1e-3, 1.0, 1e3];
    let log = Chart::new("cost", "iteration", "cost", vec![0.0, 1.0, 2.0, 3.0])
        .series("cost", Line::Points, positive)
        .log();
    let mut report = Report::new(HOSTILE);
    report.sections = vec![
        Section::new(HOSTILE)
            .text(HOSTILE)
            .table(table)
            .chart(chart(HOSTILE)),
        Section::new("more").chart(log).chart(chart("third")),
    ];
    report
}

#[test]
fn text_cannot_become_markup() {
    let html = report().html().expect("a page");
    assert!(!html.contains("<img"), "an element came from text");
    assert!(
        !html.contains("</script><script>document"),
        "a script came from text"
    );
    assert!(
        html.contains("&lt;img src=x&gt; &amp; &quot;q&quot;"),
        "the text is there"
    );
    for (_, svg) in report().figures().expect("figures") {
        assert!(!svg.contains("<img") && !svg.contains("<script"));
    }
}

#[test]
fn page_asks_for_nothing_from_outside() {
    let html = report().html().expect("a page");
    assert!(html.contains("default-src 'none'"));
    for loading in ["<link", "src=\"http", "@import", "url("] {
        assert!(!html.contains(loading), "{loading}");
    }
    assert!(
        html.contains("MIT License"),
        "uPlot's licence travels with it"
    );
}

#[test]
fn figures_draw_every_series_and_leave_gaps() {
    let report = report();
    let figures = report.figures().expect("figures");
    assert_eq!(figures.len(), 3);
    let lines = |svg: &str| svg.matches("<polyline").count();
    let solid_only = Chart::new("one", "", "", vec![0.0, 1.0, 2.0, 3.0, 4.0]);
    let count = |values: Vec<f64>| {
        let mut page = Report::new("gap");
        let chart = solid_only.clone().series("a", Line::Solid, values);
        page.sections = vec![Section::new("").chart(chart)];
        lines(&page.figures().expect("a figure")[0].1)
    };
    let whole = count(vec![0.0, 1.0, 0.0, 1.0, 0.0]);
    let split = count(vec![0.0, 1.0, f64::NAN, 1.0, 0.0]);
    assert_eq!(split, whole + 1, "a gap makes two lines of one");
    assert!(figures[1].0.starts_with("02-cost"), "{}", figures[1].0);
}

#[test]
fn wrong_lengths_are_named() {
    let mut report = Report::new("bad");
    let short =
        Chart::new("torque", "", "", vec![0.0, 1.0]).series("model", Line::Solid, vec![1.0]);
    report.sections = vec![Section::new("").chart(short)];
    let error = report.html().expect_err("a short series");
    assert!(matches!(
        error,
        ReportError::Length {
            expected: 2,
            got: 1,
            ..
        }
    ));
    assert!(
        error.to_string().contains("`torque`: series `model`"),
        "{error}"
    );
    let mut table = Table::new("t", &["a", "b"]);
    table.push(vec!["1".into()]);
    report.sections = vec![Section::new("").table(table)];
    assert!(matches!(
        report.html(),
        Err(ReportError::Row { row: 0, .. })
    ));
}

#[test]
fn charts_draw_in_a_browser_without_network() {
    // counts the pixels of every canvas that are not transparent
    let probe = "<script>addEventListener('load', () => setTimeout(() => {
        for (const c of document.querySelectorAll('canvas')) {
            const pixels = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
            let inked = 0;
            for (let i = 3; i < pixels.length; i += 4) inked += pixels[i] > 0;
            c.dataset.inked = inked > 1000 ? 'yes' : 'no';
        }
    }, 500))</script></body>";
    let html = report().html().expect("a page");
    let Some(dom) = common::browser::dom(&html.replace("</body>", probe)) else {
        return;
    };
    assert_eq!(
        dom.matches("data-drawn=\"2\"").count(),
        2,
        "two charts of two series"
    );
    assert_eq!(
        dom.matches("data-drawn=\"1\"").count(),
        1,
        "one chart of one series"
    );
    assert_eq!(
        dom.matches("data-inked=\"yes\"").count(),
        3,
        "every canvas has ink"
    );
    assert!(!dom.contains("<title>broken"), "text ran as a script");
}
