"""How the page of a run looks, and the few lines of script that move its sliders."""

STYLE = """
:root{color-scheme:light dark;--bg:#fff;--card:#f6f8fa;--ink:#1f2328;--faint:#59636e;
--line:#d1d9e0;--solved:#15803d;--sharp:#0b62c4;--failed:#c2410c}
@media (prefers-color-scheme:dark){:root{--bg:#0d1117;--card:#151b23;--ink:#e6edf3;
--faint:#9198a1;--line:#3d444d;--solved:#3fb950;--sharp:#58a6ff;--failed:#f0883e}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,'Segoe UI',sans-serif}
header,main,footer{max-width:1180px;margin:0 auto;padding:0 20px}
header{padding-top:28px}h1{font-size:24px;margin:0;overflow-wrap:anywhere}
header p,footer,figcaption,.facts,section>p{color:var(--faint)}header p{margin:2px 0 0}
h2{font-size:17px;margin:36px 0 10px;padding-top:14px;border-top:1px solid var(--line)}
h3{font-size:15px;margin:0 0 10px}
.tiles{display:flex;flex-wrap:wrap;gap:10px;margin:22px 0 0}
.tiles div{background:var(--card);border-radius:8px;padding:9px 16px;min-width:96px}
.tiles dt{color:var(--faint);font-size:13px}.tiles dd{margin:0;font-size:21px;font-weight:600;
font-variant-numeric:tabular-nums}
.tiles .solved dd{color:var(--solved)}.tiles .sharp dd{color:var(--sharp)}
.tiles .failed dd{color:var(--failed)}
nav{display:flex;flex-wrap:wrap;gap:6px;margin-bottom:12px}
nav a{color:var(--bg);background:var(--faint);text-decoration:none;border-radius:6px;
padding:2px 11px;font-variant-numeric:tabular-nums;font-size:14px}
nav .solved,.badge.solved{background:var(--solved)}nav .sharp,.badge.sharp{background:var(--sharp)}
nav .failed,.badge.failed{background:var(--failed)}
.badge{color:var(--bg);border-radius:6px;padding:1px 9px;margin-left:10px;font-size:13px;
font-weight:600}
.reel{display:flex;overflow-x:auto;scroll-snap-type:x mandatory;gap:20px;padding-bottom:8px}
.card{flex:0 0 100%;scroll-snap-align:start;scroll-margin-top:60px}
.views{display:grid;grid-template-columns:2fr 1fr;gap:14px;align-items:start}
.pair{display:grid;gap:10px}@media (max-width:760px){.views{grid-template-columns:1fr}}
figure{margin:0}figcaption{font-size:13px;display:flex;justify-content:space-between;gap:8px}
img{display:block;width:100%;height:auto;border-radius:6px}
.wipe{position:relative;--at:50%}
.wipe .sharp{position:absolute;inset:0;clip-path:inset(0 0 0 var(--at))}
.wipe::after{content:'';position:absolute;top:0;bottom:0;left:calc(var(--at) - 1px);width:2px;
background:#fff;box-shadow:0 0 4px #000;pointer-events:none}
.wipe::before{content:'\\2039\\2009\\203A';position:absolute;top:calc(50% - 15px);z-index:1;
left:calc(var(--at) - 15px);width:30px;height:30px;border-radius:50%;background:#fff;color:#1f2328;
font:600 20px/26px system-ui,sans-serif;text-align:center;box-shadow:0 0 4px #000;
pointer-events:none}
.wipe input{position:absolute;inset:0;width:100%;height:100%;margin:0;opacity:0;
cursor:ew-resize}.wipe:has(input:focus-visible){outline:2px solid var(--sharp);
outline-offset:2px;border-radius:6px}
.facts{margin:6px 0 0;font-size:14px;font-variant-numeric:tabular-nums}
.charts{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(340px,100%),1fr));gap:14px}
.chart{display:block;width:100%;height:auto}
table{border-collapse:collapse}th,td{text-align:left;padding:4px 18px 4px 0;
border-bottom:1px solid var(--line)}th{color:var(--faint);font-weight:500}
footer{padding-top:34px;padding-bottom:40px;font-size:13px}
@media print{.reel{flex-wrap:wrap}nav,.wipe input{display:none}}
"""
SCRIPT = """
for (const slider of document.querySelectorAll('.wipe input'))
  slider.addEventListener('input', () =>
    slider.parentElement.style.setProperty('--at', slider.value + '%'))
"""
