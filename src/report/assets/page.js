// draws the chart described by `chart` into the element before the calling script
function phantomChart(chart) {
  const element = document.currentScript.previousElementSibling;
  const lines = chart.series.map(s => ({
    label: s.label,
    stroke: s.stroke,
    width: s.points ? 0 : 1.5,
    dash: s.dashed ? [8, 5] : undefined,
    points: s.points ? { show: true, size: 5 } : undefined,
  }));
  const options = {
    width: Math.max(320, element.clientWidth),
    height: 300,
    series: [{ label: chart.xLabel }, ...lines],
    scales: { x: { time: false }, y: { distr: chart.log ? 3 : 1 } },
    axes: [{ label: chart.xLabel }, { label: chart.yLabel, size: 80 }],
    cursor: { sync: { key: "phantom" } },
    hooks: { draw: [() => { element.dataset.drawn = chart.series.length; }] },
  };
  const plot = new uPlot(options, [chart.x, ...chart.series.map(s => s.values)], element);
  addEventListener("resize", () => plot.setSize({ width: Math.max(320, element.clientWidth), height: 300 }));
}
