// All texts of the page, in English and Chinese. {name} is replaced by a value.

export const TEXTS = {
  // Main view
  canvas: { en: "Talking head. Use the arrow keys to turn it and Home to reset the view.", zh: "说话的头像：方向键转动，Home 键回到正面" },
  loading: { en: "Loading the head …", zh: "正在加载头像…" },
  phonesLabel: { en: "recognized speech", zh: "识别结果" },
  phones: { en: "Phones", zh: "声韵母" },
  phonesHelp: { en: "Show initials and finals instead of syllables", zh: "显示声母和韵母，而不是音节" },
  level: { en: "level", zh: "音量" },
  microphone: { en: "Microphone", zh: "麦克风" },
  sample: { en: "Sample", zh: "播放示例" },
  file: { en: "File", zh: "文件" },
  fileHelp: { en: "Play an audio file; you can also drop it on the page", zh: "播放音频文件，也可直接拖到页面上" },
  record: { en: "Record", zh: "录制" },
  recordHelp: { en: "Record the face and its sound as a video", zh: "把人脸和声音录成视频" },
  videoSaved: { en: "Saved {file}.", zh: "已保存 {file}。" },
  webmSaved: {
    en: "Saved {file}. This browser records only WebM, which VLC and browsers play but QuickTime does not. To convert it: ffmpeg -i {file} face.mp4",
    zh: "已保存 {file}。此浏览器只能录制 WebM，QuickTime 无法播放；可用 VLC 或浏览器播放，或转换：ffmpeg -i {file} face.mp4",
  },
  recordingFailed: { en: "The video could not be recorded: {reason}. Reload the page, or try another browser.", zh: "无法录制视频：{reason}。请重新加载页面，或换一个浏览器。" },
  learn: { en: "Learn my mouth", zh: "学我的口型" },
  learnHelp: { en: "Teach the head to move its lips like yours", zh: "让头像学会你的口型" },
  sound: { en: "Sound", zh: "声音" },
  soundInsecure: {
    en: "Sound needs https. Open this page at an https address or at http://localhost.",
    zh: "播放声音需要 https。请用 https 地址或 http://localhost 打开本页。",
  },
  soundFailed: { en: "The sound could not be turned on: {reason}. Reload the page.", zh: "无法打开声音：{reason}。请重新加载页面。" },
  turnOnSound: { en: "Turn on sound", zh: "打开声音" },

  // Status
  sessionName: { en: "session {name}", zh: "会话 {name}" },
  disconnected: { en: "disconnected", zh: "已断开" },
  connecting: { en: "connecting …", zh: "连接中…" },
  live: { en: "live", zh: "实时" },
  behind: { en: "behind", zh: "滞后" },
  behindBusy: { en: "behind: this computer is busy", zh: "滞后：这台电脑很忙" },
  seconds: { en: "{seconds} s", zh: "{seconds} 秒" },
  interrupted: { en: "interrupted", zh: "已中断" },
  waiting: { en: "waiting for speech", zh: "等待语音" },
  soundDelay: { en: "sound delay {ms} ms", zh: "声音延迟 {ms} ms" },
  turnedFront: { en: "from the front", zh: "正面" },
  turned: { en: "turned {directions}", zh: "{directions}" },
  turnedLeft: { en: "{degrees}° to the left", zh: "向左 {degrees}°" },
  turnedRight: { en: "{degrees}° to the right", zh: "向右 {degrees}°" },
  turnedUp: { en: "{degrees}° up", zh: "向上 {degrees}°" },
  turnedDown: { en: "{degrees}° down", zh: "向下 {degrees}°" },

  // Hints: what is wrong, and what to do
  closePrograms: {
    en: "Close other programs, and other windows that show this page.",
    zh: "请关闭其他程序，以及显示本页的其他窗口。",
  },
  lowerFrameRate: { en: "Lower the frame rate", zh: "降低帧率" },
  useLightModel: { en: "Use the light model", zh: "使用轻量模型" },
  gatewayLost: {
    en: "The gateway does not answer. Check the network, or start the gateway with “kouxing run”; this page will reconnect automatically.",
    zh: "网关没有应答。请检查网络，或运行 kouxing run；本页会自动重新连接。",
  },
  connectionRejected: {
    en: "The gateway rejected the connection. Open the full URL that “kouxing run” printed, including #token=… if it has one.",
    zh: "网关拒绝了连接。请打开 kouxing run 显示的完整地址（包括其中的 #token=…）。",
  },
  controlMissing: {
    en: "Control is not running. Start it with “kouxing run”; this page will reconnect automatically.",
    zh: "控制服务（control）没有运行。请运行 kouxing run，本页会自动重新连接。",
  },
  servicesMissing: {
    en: "Not running: {services}. “kouxing run” restarts services automatically. Otherwise, start them with: {commands}",
    zh: "没有运行：{services}。kouxing run 会自动重启服务；否则请运行：{commands}",
  },
  microphoneInterrupted: { en: "The microphone was interrupted. It reconnects automatically.", zh: "麦克风中断，会自动重新连接。" },
  fileInterrupted: {
    en: "The connection was interrupted. The file continues automatically.",
    zh: "连接中断，文件会自动继续播放。",
  },
  fileResumed: { en: "The file is playing again.", zh: "文件已恢复播放。" },
  microphoneResumed: { en: "The microphone is on again.", zh: "麦克风已恢复。" },
  recovered: { en: "All services are back.", zh: "已全部恢复运行。" },
  serviceRestarted: { en: "A service crashed and was restarted. The session continues.", zh: "一个服务崩溃后已重启，会话继续。" },

  // Errors
  headMissing: {
    en: "Cannot load {file}: {reason}. Check the network and choose the head again, or create the file with “kouxing head export”.",
    zh: "无法加载 {file}：{reason}。请检查网络后重新选择头像，或用 kouxing head export 生成该文件。",
  },
  webGlMissing: {
    en: "This browser cannot draw 3-D images (WebGL). Turn on hardware acceleration in its settings, or use another browser.",
    zh: "浏览器无法绘制 3-D 图像（WebGL）。请在浏览器设置中打开硬件加速，或换一个浏览器。",
  },
  microphoneInsecure: {
    en: "The microphone needs https. Open this page at an https address or at http://localhost.",
    zh: "使用麦克风需要 https。请用 https 地址或 http://localhost 打开本页。",
  },
  microphoneForbidden: {
    en: "The microphone is blocked. Allow it for this page in the browser and try again.",
    zh: "未允许使用麦克风。请在浏览器中允许本页使用，然后重试。",
  },
  microphoneMissing: {
    en: "No microphone was found. Connect one and press Microphone again.",
    zh: "没有找到麦克风。请接上后再按“麦克风”。",
  },
  microphoneMuted: {
    en: "The microphone is muted. Unmute it in the system settings, in the browser, or on the microphone itself.",
    zh: "麦克风已静音。请在系统、浏览器或麦克风上取消静音。",
  },
  microphoneUnplugged: {
    en: "The microphone was unplugged. Plug it in and press Microphone again.",
    zh: "麦克风断开了。请接上后再按“麦克风”。",
  },
  microphoneFailed: {
    en: "Cannot use the microphone: {reason}. Close other programs that use it, or choose another microphone in the browser.",
    zh: "无法使用麦克风：{reason}。请关闭占用麦克风的其他程序，或在浏览器中选择另一个麦克风。",
  },
  microphoneStopped: {
    en: "The gateway closed the connection. Press Microphone to try again.",
    zh: "网关关闭了连接。请再按“麦克风”重试。",
  },
  fileFailed: {
    en: "Cannot play the file: {reason}. Try again, or choose another file.",
    zh: "无法播放文件：{reason}。请重试，或选择其他文件。",
  },
  fileStopped: {
    en: "The gateway closed the connection. Choose the file again.",
    zh: "网关关闭了连接。请重新选择文件。",
  },
  fileUnreadable: {
    en: "The browser cannot read {file}. It may be a folder, or it may have been moved or deleted. Choose the file again.",
    zh: "浏览器无法读取 {file}。它可能是文件夹，或者已被移动或删除。请重新选择文件。",
  },
  severalFiles: {
    en: "Only one file plays at a time. Playing {file}; drop the others when it ends.",
    zh: "一次只能播放一个文件：{file}。请在播放结束后再拖入其他文件。",
  },
  fileTooLarge: { en: "The file is larger than 200 MB. Use a smaller file.", zh: "文件大于 200 MB，请用较小的文件。" },
  noSpeech: {
    en: "No speech was found in {file}. Choose a recording with a clear voice.",
    zh: "{file} 里没有找到语音。请选择人声清晰的录音。",
  },
  noSpeechSilent: {
    en: "No speech was found: {file} is silent. Choose another file, or record it again with the microphone on.",
    zh: "没有找到语音：{file} 是静音的。请选择其他文件，或打开麦克风重新录音。",
  },
  oldMouthProfile: {
    en: "The stored mouth profile does not fit this version. Press Learn my mouth and record again.",
    zh: "保存的口型不适用于当前版本。请按“学我的口型”重新录制。",
  },

  // Settings
  settings: { en: "Settings", zh: "设置" },
  head: { en: "Head", zh: "头像" },
  drawnInSoftware: {
    en: "No graphics card was found, so the head is drawn with fewer triangles and pixels: {size}",
    zh: "没有找到显卡，因此用较少的三角形和像素绘制头像：{size}",
  },
  restoreFrameRate: { en: "Restore the full frame rate", zh: "恢复完整帧率" },
  lightModel: { en: "light model", zh: "轻量模型" },
  useFullModel: { en: "Use the full model", zh: "使用完整模型" },
  lips: { en: "Lips", zh: "口型" },
  speechLanguage: { en: "Speech language", zh: "说话的语言" },
  anyLanguage: {
    en: "The default lips work in any language. Captions and the other lip models need the language of the speech.",
    zh: "默认口型适用于任何语言。字幕和其他口型需要选择说话的语言。",
  },
  expressiveness: { en: "Mouth movement", zh: "口型幅度" },
  captions: { en: "Captions", zh: "字幕" },
  still: { en: "Keep the head still", zh: "头部保持不动" },
  eye_contact: { en: "Keep eye contact", zh: "始终看着观众" },
  feeling: { en: "Emotion from the voice", zh: "随声音流露的情绪" },
  expression: { en: "Expression", zh: "表情" },
  senders: { en: "Other programs", zh: "其他程序" },
  senderAddress: { en: "Address of the program that shows the face", zh: "显示这张脸的程序的地址" },
  send: { en: "Send", zh: "发送" },
  stop: { en: "Stop", zh: "停止" },
  start: { en: "Start", zh: "开始" },
  senderState: { en: "{contents}, {rate} frames/s", zh: "{contents}，每秒 {rate} 帧" },
  senderStateDelayed: {
    en: "{contents}, {rate} frames/s, delayed {delay} ms",
    zh: "{contents}，每秒 {rate} 帧，延迟 {delay} ms",
  },
  delaySenders: { en: "Delay these programs by {ms} ms to match this page's sound", zh: "把这些程序延迟 {ms} ms，以配合本页的声音" },
  playoutDelays: {
    en: "The sound is delayed by {soundMs} ms to match the picture. To match the face in another program to this sound, add delay={frameMs} to its address.",
    zh: "声音延迟 {soundMs} ms 以配合画面。要让其他程序的脸与此声音同步，请在地址中加 delay={frameMs}。",
  },
  language: { en: "Language", zh: "语言" },
  "head.": { en: "default", zh: "默认" },
  "head.woman": { en: "woman", zh: "女士" },
  "head.man": { en: "man", zh: "男士" },
  "head.elder": { en: "older man", zh: "老人" },
  "head.child": { en: "child", zh: "孩子" },
  "head.ada": { en: "Ada", zh: "艾达" },
  "head.leo": { en: "Leo", zh: "利奥" },
  "head.rosa": { en: "Rosa", zh: "罗莎" },
  "head.mika": { en: "Mika (cartoon)", zh: "米卡（卡通）" },
  "expression.smile": { en: "smile", zh: "微笑" },
  "expression.joy": { en: "joy", zh: "高兴" },
  "expression.surprise": { en: "surprise", zh: "惊讶" },
  "expression.sadness": { en: "sadness", zh: "悲伤" },
  "expression.anger": { en: "anger", zh: "生气" },
  "expression.fear": { en: "fear", zh: "害怕" },
  "expression.disgust": { en: "disgust", zh: "厌恶" },

  // Learn my mouth
  learnIntro: {
    en: "Read a text aloud in front of your camera for 40 seconds. From then on, when you use the microphone, the head moves its lips as you do.",
    zh: "对着摄像头朗读一段文字 40 秒。之后你用麦克风时，头像就会像你一样动嘴唇。",
  },
  learnPrivacy: {
    en: "No camera image leaves this browser. The gateway receives your voice and the positions of 43 points on your face, and deletes both after learning.",
    zh: "摄像头的图像不会离开浏览器。网关只收到你的声音和脸上 43 个点的位置，学完即删除。",
  },
  learnedOn: {
    en: "Your mouth was learned on {day}. Similarity of the mouth opening: {before} → {after}.",
    zh: "{day} 学会了你的口型。张口幅度的相似度：{before} → {after}。",
  },
  learnForget: { en: "Forget it", zh: "删除" },
  learnText: { en: "Text", zh: "文本" },
  close: { en: "Close", zh: "关闭" },
  cancel: { en: "Cancel", zh: "取消" },
  secondsLeft: { en: "seconds left", zh: "剩余秒数" },
  time: { en: "time", zh: "时间" },
  learnFinish: { en: "I'm done reading", zh: "读完了" },
  learnProgress: { en: "Learning your mouth. This takes a few seconds …", zh: "正在学习你的口型，需要几秒钟…" },
  learnTracking: {
    en: "You can stop reading. This computer is slow, so it is analyzing the recorded images now: {percent} %.",
    zh: "可以停止朗读了。这台电脑较慢，正在查找画面中的嘴唇：{percent} %。",
  },
  learning: { en: "learning", zh: "学习中" },
  resultCurves: { en: "lip opening over time", zh: "张口幅度随时间的变化" },
  yourLips: { en: "your lips", zh: "你的嘴唇" },
  before: { en: "before", zh: "之前" },
  after: { en: "after", zh: "之后" },
  resultSimilarity: { en: "How closely the head's lips follow yours (1 = a perfect match)", zh: "与你的相似度（1 为完全一致）" },
  resultHeldOut: {
    en: "Measured on the last quarter of your reading, which was not used for learning.",
    zh: "用朗读的最后四分之一测得，这部分没有用于学习。",
  },
  discard: { en: "Discard", zh: "放弃" },
  keep: { en: "Keep", zh: "保留" },
  recordAgain: { en: "Record again", zh: "重录" },
  sendAgain: { en: "Send again", zh: "重发" },
  learnStarting: {
    en: "Starting camera, microphone and face tracking. On a slow computer or connection, this takes up to a minute. Closing other programs helps.",
    zh: "正在启动摄像头、麦克风和面部跟踪。电脑或网络较慢时最多需要一分钟，可关闭其他程序。",
  },
  learnShowFace: { en: "Show your face to the camera.", zh: "请把脸对准摄像头。" },
  learnLipsClosed: { en: "Keep your lips closed …", zh: "请先闭上嘴…" },
  learnRead: { en: "Read aloud. Repeat the text if there is time left.", zh: "请朗读，读完可重复。" },
  "measure.opening": { en: "Opening", zh: "张口幅度" },
  "measure.width": { en: "Width", zh: "宽度" },
  "measure.jaw": { en: "Jaw", zh: "下颌" },
  resultBetter: { en: "The head's lips now follow yours more closely.", zh: "现在头像的口型更像你了。" },
  resultSame: { en: "The head's lips follow yours about as well as before.", zh: "头像的口型与你的相似程度和以前差不多。" },
  resultWorse: {
    en: "The head's lips do not follow yours. Discard the result and try again, with light on your face and no other voices.",
    zh: "头像的口型不像你。请放弃结果，在脸部有光、没有其他人说话的地方再试。",
  },
  noFace: { en: "No face is visible. Sit in front of the camera, with light on your face.", zh: "看不到脸。请坐在摄像头前，脸部要有光。" },
  tooQuiet: { en: "Your voice is too quiet. Speak louder, or turn up the microphone.", zh: "声音太小。请大声一点，或调高麦克风音量。" },
  tooSlow: {
    en: "This computer is too slow to track your face. Close other programs and try again. Or film yourself and use kouxing track and kouxing adapt.",
    zh: "这台电脑太慢，无法跟踪你的脸。请关闭其他程序再试，或录一段视频，用 kouxing track 和 kouxing adapt 学习。",
  },
  cameraInsecure: {
    en: "The camera needs https. Open this page at an https address or at http://localhost.",
    zh: "使用摄像头需要 https。请用 https 地址或 http://localhost 打开本页。",
  },
  cameraForbidden: {
    en: "The camera or the microphone is blocked. Allow both for this page and try again.",
    zh: "未允许使用摄像头或麦克风。请允许本页使用两者，然后重试。",
  },
  cameraMissing: { en: "No camera or microphone was found. Connect both and try again.", zh: "没有找到摄像头或麦克风。请接上两者后重试。" },
  cameraBusy: {
    en: "Another program uses the camera or the microphone. Close it and try again.",
    zh: "摄像头或麦克风被其他程序占用。请关闭后重试。",
  },
  cameraUnplugged: { en: "The camera or the microphone was unplugged. Plug it in and try again.", zh: "摄像头或麦克风断开了。请接上后重试。" },
  learnHidden: {
    en: "The recording stopped because this page was hidden. Keep the page in front while you read, and try again.",
    zh: "页面被隐藏，录制已停止。朗读时请让本页保持在最前面，然后重试。",
  },
  trackerFailed: {
    en: "Face tracking does not work in this browser: {reason}. Use a current version of Chrome, Edge or Firefox.",
    zh: "此浏览器无法跟踪面部：{reason}。请用最新版的 Chrome、Edge 或 Firefox。",
  },
  gatewaySilent: {
    en: "The gateway does not answer. Check the network, or start the gateway with “kouxing run”, and try again.",
    zh: "网关没有应答。请检查网络，或运行 kouxing run，然后重试。",
  },
};

// The text to read aloud: "The North Wind and the Sun" by Aesop, which is common in phonetics.
export const READING_TEXTS = {
  zh:
    "有一回，北风跟太阳正在那儿争论谁的本事大。说着说着，来了一个过路的，身上穿着一件厚袍子。它们俩就商量好了，" +
    "说谁能先叫这个过路的把他的袍子脱下来，就算谁的本事大。北风就使劲儿地吹起来了，可是它越是吹得厉害，那个人就把袍子裹得越紧。" +
    "后来北风没法子了，只好就算了。过了一会儿，太阳出来了，热热地一晒，那个人马上就把袍子脱下来了。" +
    "北风不得不承认，还是太阳比它的本事大。",
  en:
    "The North Wind and the Sun were disputing which was the stronger, when a traveller came along " +
    "wrapped in a warm cloak. They agreed that the one who first succeeded in making the traveller " +
    "take his cloak off should be considered stronger than the other. Then the North Wind blew as " +
    "hard as he could, but the more he blew the more closely did the traveller fold his cloak " +
    "around him; and at last the North Wind gave up the attempt. Then the Sun shone out warmly, and " +
    "immediately the traveller took off his cloak. And so the North Wind was obliged to confess " +
    "that the Sun was the stronger of the two.",
};
