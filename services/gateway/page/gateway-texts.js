// Chinese for the texts of the gateway. {name} is a placeholder for a value, which is also translated.

const CHINESE = {
  // Files: the same texts as the commands print
  "the file is empty; copy or record it again": "文件是空的，请重新复制或录制",
  "cannot read audio: this is {kind}": "无法读取声音：这是{kind}",
  "text, not audio: {text}; use an audio file": "文本，不是声音：{text}；请用声音文件",
  "a zip archive; unpack it first": "zip 压缩包，请先解压",
  "a gzip archive; unpack it first": "gzip 压缩包，请先解压",
  "a 7z archive; unpack it first": "7z 压缩包，请先解压",
  "a rar archive; unpack it first": "rar 压缩包，请先解压",
  "a PDF document; use an audio file": "PDF 文档，请用声音文件",
  "a picture; use an audio file": "图片，请用声音文件",
  "an avatar, not audio; show it with --head of kouxing run or render": "虚拟形象，不是声音；请用 kouxing run 或 render 的 --head 显示它",
  "a SILK voice message; convert it to wav first": "SILK 语音消息，请先转成 wav",
  "a MIDI file, which contains notes, not audio; render it to wav with a synthesizer": "MIDI 文件，只有音符没有声音；请先用合成器转成 wav",
  "cannot read audio: the file has only zeros; copy or record it again": "无法读取声音：文件里全是零，请重新复制或录制",
  "cannot read audio: the file is cut off before its index; copy or record it again": "无法读取声音：文件不完整，缺少索引；请重新复制或录制",
  "cannot read audio: the file is damaged or cut off ({reason}); copy it again": "无法读取声音：文件损坏或不完整（{reason}），请重新复制",
  "cannot read audio from this file ({reason}); use wav, flac, mp3, m4a, mp4, webm or ogg. Raw samples need: kouxing speak --raw":
    "无法从此文件读取声音（{reason}），请用 wav、flac、mp3、m4a、mp4、webm 或 ogg。原始采样请用 kouxing speak --raw",
  "the file contains samples without a header; convert it to wav with FFmpeg, and specify their format and rate": "文件只有采样，没有文件头；请用 FFmpeg 按其格式和采样率转成 wav",
  "the file contains no samples; record it again": "文件里没有声音数据，请重新录制",
  "the audio is encrypted (DRM); use a copy without protection": "声音已加密（DRM），请用没有保护的副本",
  "the audio is damaged or encrypted; nothing can be decoded; export it again": "声音已损坏或加密，无法解码；请重新导出",
  "the file has {kind} but no audio track": "文件里只有{kind}，没有声音轨道",
  attachment: "附件",
  audio: "音频",
  data: "数据",
  subtitle: "字幕",
  video: "视频",
  "the codec of audio track {track} is unknown; export the audio as wav, flac, mp3 or m4a": "无法识别第 {track} 条音轨的编码，请导出为 wav、flac、mp3 或 m4a",
  "{codec} is not supported; export the audio as 16-bit PCM": "不支持 {codec}，请导出为 16 位 PCM",
  "{count} audio tracks: {tracks}. This reads track {track}; choose another with --track":
    "有 {count} 条音轨：{tracks}。现在播放第 {track} 条；其他音轨可用 --track 选择",
  "the file is cut off after {read} s of {whole} s": "文件不完整：只有 {read} 秒，应有 {whole} 秒",
  "the file is cut off after {read} s": "文件不完整：只有 {read} 秒",
  "the file has several audio parts; convert them separately": "文件里有几段声音，请分别转换",
  "the encoding of the audio changes; convert each part separately": "声音的编码中途改变，请分别转换",
  "the file cannot be read after {read} s; export it again": "{read} 秒之后无法读取，请重新导出",
  "cannot be read to the end: {reason}": "无法读到结尾：{reason}",
  "damaged near {place} s; the damaged part is silent": "{place} 秒附近已损坏，损坏部分无声",
  "mixing the channels would cancel one of them; only channel {channel} is used": "如混合所有声道，会丢失其中一个声道的声音，因此只用第 {channel} 声道",
  "{share} of the samples are clipped; record at a lower level": "{share} 的采样过载失真，请降低录音音量",
  "the samples have a constant offset of {offset}, which hides quiet speech; subtract it in an audio editor":
    "声音有恒定的直流偏移（{offset}），会掩盖较轻的语音，请用音频编辑器去除",
  "a sample is {value}, but full scale is 1; divide integers by 32768, and export the file again":
    "采样值达到 {value}，而满刻度是 1；请把整数除以 32768 后重新导出",
  "{rate} Hz is too low for speech; use {least} Hz or more": "采样率 {rate} Hz 太低，请用 {least} Hz 以上",
  "NaN or infinite samples near {place} s; export the file again, for example as 16-bit PCM":
    "{place} 秒附近有无效采样，请重新导出，例如 16 位 PCM",
  "the audio is longer than {hours} h; use a shorter file": "声音长于 {hours} 小时，请用较短的文件",
  "another file is being read; try again in a few seconds": "正在读取另一个文件，请几秒后重试",
  "the file did not arrive within {limit} s; use a smaller file or a faster connection": "文件未在 {limit} 秒内传完，请用较小的文件或更快的网络",
  "the file is larger than {size} MiB; use a smaller one": "文件大于 {size} MiB，请用较小的文件",
  "this is a big-endian WAV file; export it as wav or flac": "这是大端序的 WAV 文件，请导出为 wav 或 flac",
  "the file cannot be decoded; export it again": "文件无法解码，请重新导出",
  "the gateway cannot store the file: {reason}; free space in its temporary folder, or set TMPDIR to another folder and restart the gateway":
    "网关无法存储文件：{reason}；请在其临时文件夹中腾出空间，或把 TMPDIR 设为其他文件夹并重启网关",
  "the disk is full": "磁盘已满",
  "reading the file took too long; use a shorter file": "读取时间太长，请用较短的文件",

  // Sessions
  "control at {address} does not answer. Start it with 'kouxing run'": "控制服务（{address}）没有应答，请运行 kouxing run",
  "control at {address} does not answer: {reason}": "控制服务（{address}）没有应答：{reason}",
  "control at {address} does not accept this key. If it belongs to another user, start your own with 'kouxing run'. If it is yours, restart it. If it runs on another machine, run 'kouxing keys add NAME --role client' there and copy the file here": "控制服务（{address}）不接受此密钥。如果它属于另一个用户，请用 kouxing run 启动自己的控制服务；如果是你自己的，请重启它；如果它在另一台机器上运行，请在那里运行 kouxing keys add NAME --role client，并把文件复制到这里",
  "control has closed the session: {reason}": "控制服务关闭了会话（{reason}）",
  "the session is closed": "会话已关闭",
  "no session is shown; start a microphone or the sample first": "没有显示会话，请先打开麦克风或播放示例",
  "the light model has only Mandarin; show a session in Mandarin": "轻量模型只支持普通话，请显示普通话的会话",
  "another program opened this session; only that program can send audio": "此会话由另一个程序打开，只有该程序可以发送声音",

  "session {name} is open; choose another name": "会话 {name} 已存在，请换一个名称",
  "wrong token for session {name}; use the token from session-opened": "会话 {name} 的令牌不对，请用 session-opened 中的令牌",
  "session {name} does not exist; open it first": "会话 {name} 不存在，请先打开",
  "the limit of control.max_sessions is reached: {count}": "会话数已达上限 control.max_sessions：{count}",
  "your key has {count} open sessions, the maximum; close one first": "此密钥已有 {count} 个会话，达到上限，请先关闭一个",
  "too many services are registered; stop some": "服务太多，请先停止一些",
  "the key {name} has no role {roles}; on control's machine, 'kouxing keys list' shows the roles, and 'kouxing keys add' creates another key":
    "网关的密钥 {name} 没有权限（{roles}）；在运行控制服务的机器上，kouxing keys list 显示权限，kouxing keys add 创建另一个密钥",
  "no {kind} has the language {language}; choose another one": "没有 {kind} 能识别语言 {language}，请在“设置”中选择其他语言",
  "{missing}; {start} (or everything with 'kouxing run')": "{missing}，{start}（或用 kouxing run 启动全部服务）",
  "no {kind} is running": "没有运行 {kind}",
  "start one with 'kouxing {kind}'": "请运行 kouxing {kind}",
  "every {kind} is busy: a session needs {needed} % of one, but at most {left} % is free; try again in {wait} s":
    "所有 {kind} 都忙：需要 {needed}% 的空闲时间，只剩 {left}%；请 {wait} 秒后重试",
  "{workers} did not start the session in time": "{workers} 没有及时启动会话",
  "the synthesizer is too slow, so the face misses part of the speech": "合成器太慢，因此脸上缺少部分语音",

  // Learn my mouth
  "the gateway is stopping": "网关正在停止",
  "another mouth profile is being created; try again in a minute": "正在学习另一个口型，请一分钟后重试",
  "learning failed; see the gateway's log": "学习失败，请查看网关日志",
  "the recording is larger than {size} MiB": "录制大于 {size} MiB",
  "the recording did not arrive within {limit} s": "录制未在 {limit} 秒内传完",
  "learning took longer than {limit} s; try again later": "学习超过 {limit} 秒，请稍后重试",
  "the landmarks do not form an upright face; film the face from the front": "特征点不构成正面直立的脸，请正对摄像头拍摄",
  "the landmarks of a frame coincide; omit frames without a face": "有一帧的特征点重合，请去掉没有脸的帧",
  "a face is visible in only {count} frames; film it for 20 s or more": "只有 {count} 帧能看到脸，请录 20 秒以上",
  "it has less than a second of audio": "声音不到一秒",
  "only {speech} s of speech show the lips; film {least} s or more, preferably a minute":
    "只有 {speech} 秒语音能看到嘴唇，请录 {least} 秒以上，最好一分钟",

  // Other programs
  "VRM shapes": "VRM 形状",
  "ARKit shapes": "ARKit 形状",
  "Oculus visemes": "Oculus 口型",
  "tracking parameters": "追踪参数",
  "{contents} of the mouth": "嘴部的{contents}",
  "{contents} and head": "{contents}和头部",
  "no program is listening on {address}; turn its receiver on": "{address} 没有程序接收，请在该程序中打开接收",
  "cannot receive from a tracker on {host}:{port}: {reason}; choose another address or port":
    "无法在 {host}:{port} 接收面部追踪数据：{reason}，请换一个地址或端口",
  "camera must be a port such as 39541, or ADDRESS:PORT, not {text}":
    "camera 应为端口（例如 39541）或 地址:端口，而不是 {text}",
  "camera={port} is the port of the avatar program itself; choose another port, and set the tracker to send to it":
    "camera={port} 是虚拟形象程序自己的端口；请换一个端口，并让面部追踪程序发送到它",
  "only=mouth lets another program control the head; leave out head=on":
    "only=mouth 表示头部由其他程序控制，请去掉 head=on",
  "the connection ended: {error}; stop and restart sending": "连接已结束：{error}；请停止后重新发送",
  "cannot send a frame: {error}": "无法发送画面数据：{error}",
  "cannot reach {address}: {reason}; check the address and the network": "无法连接 {address}：{reason}，请检查地址和网络",
  "VTube Studio is asking whether kouxing may move the model; press Allow there": "VTube Studio 正在询问是否允许 kouxing，请在那里点“Allow”",
  "VTube Studio's API is off; turn on 'Start API (allow plugins)' in its settings":
    "VTube Studio 的 API 未打开，请在其设置中打开“Start API (allow plugins)”",
  "access to VTube Studio was denied; to get the prompt again, stop and restart sending": "VTube Studio 拒绝了访问；停止后再开始发送会重新询问",
  "the program at this address is not VTube Studio; check the port in its settings (8001 by default)":
    "此地址的程序不是 VTube Studio，请核对其设置中的端口（默认 8001）",
  "another plugin sets the same parameters: {text}": "另一个插件在设置同样的参数：{text}",
  "VTube Studio closed the connection; trying again": "VTube Studio 断开了连接，正在重试",
  "VTube Studio is not running at {address}; start it, and turn on 'Start API (allow plugins)' in its settings":
    "{address} 没有 VTube Studio，请启动它并在设置中打开“Start API (allow plugins)”",
  "already sending to {count} programs; stop one first": "已在向 {count} 个程序发送，请先停止一个",
  "{host} is another machine; add the address to gateway.senders, or use 'kouxing send'":
    "{host} 是另一台机器；请把地址加入 gateway.senders，或用 kouxing send",
  "camera={address} accepts data from other machines; write only its port, add the address to gateway.senders, or use 'kouxing send'":
    "camera={address} 接受其他机器的数据；请只写端口，或把地址加入 gateway.senders，或用 kouxing send",
  "{url} is not a valid address; write {forms}": "地址 {url} 无效，请写 {forms}",
  "prefix must start with '/'": "prefix 必须以“/”开头",
  "unknown option {name}; use {options}": "没有选项 {name}，可用 {options}",
  "the delay must be 0 or 1 to {most} ms, not {delay}; a value in seconds must be multiplied by 1000":
    "延迟必须是 0 或 1 到 {most} 毫秒，不能是 {delay}；以秒为单位的数请乘以 1000",
  "{name} must be {values}": "{name} 必须是 {values}", // the first text that fits is used
  "{name} contains a character that is not printable": "{name} 含有不可打印的字符",
  "{name} is longer than {count} characters": "{name} 超过 {count} 个字符",
};

// Reasons of control's errors, for texts that are not translated above
const REASONS = {
  "bad-audio": "音频有误",
  "bad-face": "此设置无效",
  "bad-language": "没有识别器能识别此语言",
  "bad-message": "请求无效",
  "bad-mouth-profile": "口型不适用",
  "bad-token": "会话的令牌无效",
  busy: "系统繁忙，请稍后再试",
  finished: "会话已结束",
  "no-link": "服务之间无法连接，请运行 kouxing doctor",
  "no-service": "缺少服务，请运行 kouxing run",
  "no-video": "无法录制视频，请查看驱动服务的日志",
  "not-allowed": "网关的密钥没有权限，见 kouxing keys list",
  "session-exists": "同名会话已存在",
  "short-video": "视频提前结束",
  timeout: "服务没有及时应答，请重试",
  "too-many-services": "服务太多，请先停止一些",
  "too-many-sessions": "会话太多，请先关闭一些",
  "unknown-session": "会话已不存在",
};

const PATTERNS = Object.entries(CHINESE).map(([english, chinese]) => {
  const literals = english.split(/\{\w+\}/).map((part) => part.replace(/[.*+?^${}()|[\]\\]/g, "\\$&"));
  const names = [...english.matchAll(/\{(\w+)\}/g)].map(([, name]) => name);
  // A value at the start contains no ": ", which follows the name of a file or a sender.
  const pattern = literals.join("(.+?)").replace(/^\(\.\+\?\)/, "((?:(?!: ).)+?)");
  return { pattern: new RegExp(`^${pattern}$`), names, chinese };
});

/** Translate lines of the form "text" or "file: text". Unknown texts stay English. */
export function toChinese(text) {
  if (text.includes("\n")) return text.split("\n").map(toChinese).join("\n");
  for (const { pattern, names, chinese } of PATTERNS) {
    const values = pattern.exec(text)?.slice(1).map(toChinese);
    if (values) return chinese.replace(/\{(\w+)\}/g, (_, name) => values[names.indexOf(name)]);
  }
  const [, subject, rest] = /^(.+?): (.+)$/.exec(text) ?? [];
  return subject === undefined ? text : `${subject}：${toChinese(rest)}`;
}

/** Translate an error of control. If its text has no translation, its code states the reason. */
export function errorToChinese(code, text) {
  const chinese = toChinese(text);
  return chinese === text && code in REASONS ? `${REASONS[code]}：${text}` : chinese;
}
